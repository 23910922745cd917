"""From FP32 to INT8: observe, choose, quantize, and write the artifact."""
