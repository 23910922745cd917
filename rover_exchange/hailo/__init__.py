"""Make a kit for Hailo's compiler: a policy's networks in ONNX, a calibration set, and what compiles and packs."""
