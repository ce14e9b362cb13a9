"""Formats and precisions of exported units."""

SUFFIXES = {"onnx": ".onnx", "torch_export": ".pt2"}
"""File name suffix of each format."""

PRECISIONS = {"onnx": ("float32", "int8"), "torch_export": ("bfloat16", "float32")}
"""Precisions of each format."""
