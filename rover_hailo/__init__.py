"""Make a kit for Hailo's compiler: a policy as networks that its parser should take, and all that compiling them needs.

    write_kit(load("best_model.pth", "episodes"), "kit", samples=1024)        # in `kit`

There are two ways to split the policy. With `backbone` the chip turns pictures into projected features, and ONNX
Runtime runs the transformer after it. With `whole` everything runs on the chip. Nobody here has Hailo's compiler or a
chip; docs/hailo.md says what of this was tried, and on what.
"""
