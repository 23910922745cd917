"""Make a kit for Hailo's compiler: a policy's networks in ONNX, a calibration set, and what compiles and packs.

    write_kit(open_run("runs/mine"), "runs/mine", "kit", samples=1024)

The chip turns pictures into projected features, and ONNX Runtime runs the transformer after it. Nobody here has
Hailo's compiler or a chip; docs/hailo.md says what of this was tried, and on what.
"""
