"""Learned methods, one module or package each; registries name them by import path, as they name plug-ins."""
