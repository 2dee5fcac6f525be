"""The field that is trained: on tensors and compiled, with its optimiser."""
