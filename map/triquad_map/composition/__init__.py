"""Many regions as one map: who answers where, and how what they answer becomes one."""
