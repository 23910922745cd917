"""What is known of each operator in Hailo's parser. None of it was tried here."""

OPERATORS = {
    "Conv": "the chip's own; the zoo's ResNets and the backbone of its DETR consist of it",
    "Relu": "part of the convolution before it",
    "MaxPool": "in the zoo's ResNets, with this very kernel",
    "Add": "of a bias: part of the layer; of two tensors, or of one and a constant (const_input): ew_add, as DETR's "
    "positions and residuals are",
    "MatMul": "with weights: a convolution of 1x1; of two tensors: matmul, with a constant query too, as in the zoo's "
    "DETR",
    "Reshape": "features of a picture into tokens, and tokens into heads and back: as timm's ViT has them in the zoo; "
    "in other orders, UnsupportedShuffleLayerError is the parser's most frequent answer",
    "Transpose": "see Reshape; two in a row are one here",
    "Concat": "of tokens, as ViT's class token",
    "Mul": "with a constant: ew_mult, or part of the layer before it; ViT's scaling of queries",
    "Softmax": "over the last axis, decomposed into reduce_max, ew_sub, reduce_sum and ew_mult; 16 bits there ended "
    "the compiler 5.3 for a 10H (a report in Hailo's forum), so it stays at 8",
    "LayerNormalization": "over the last axis since opset 17, decomposed; the zoo's vit_*_ops17 have it",
    "Erf": "of GELU, as in ViT",
    "Div": "of GELU, as in ViT",
}
