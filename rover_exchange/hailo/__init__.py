"""Make a kit for Hailo's compiler: a policy's networks in ONNX, a calibration set, and what compiles and packs them.

    write_kit(open_run("runs/mine"), "runs/mine", "kit", samples=1024)

There are two ways to split the policy. With `backbone` the chip turns pictures into projected features, and ONNX
Runtime runs the transformer after it. With `whole` everything runs on the chip. Nobody here has Hailo's compiler or a
chip; docs/hailo.md says what of this was tried, and on what.
"""
