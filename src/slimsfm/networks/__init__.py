"""Networks in PyTorch, by the names that their published weights use."""
