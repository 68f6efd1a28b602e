"""Exported encoders: jax programs, ONNX, and engines that run them."""
