"""The field that is trained, on tensors or compiled, with its optimiser."""
