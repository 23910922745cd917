"""A kit for Hailo's compiler: a policy as networks that its parser should take, with all that compiling them needs.

    write_kit(load("best_model.pth", "episodes"), "kit", samples=1024)        # in `kit`

Two splits. `backbone`: pictures to projected features on the chip, the transformer in ONNX Runtime behind it. `whole`:
everything on the chip. Nobody here has Hailo's compiler or a chip: what of this was tried, and on what, is in
docs/hailo.md.
"""
