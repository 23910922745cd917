"""Does static INT8 hold for policies that nobody tuned it for?"""
