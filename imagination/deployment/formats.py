"""What units can be exported to."""

SUFFIXES = {"onnx": ".onnx", "torch_export": ".pt2"}
"""Of each format's files."""

PRECISIONS = {"onnx": ("float32", "int8"), "torch_export": ("bfloat16", "float32")}
"""That each format can be written in."""
