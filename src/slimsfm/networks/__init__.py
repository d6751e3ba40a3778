"""Running neural networks: loading weights, choosing a device, ONNX files."""
