"""Encoders of other families: DINOv2, Sparsh, T3, SITR, AnyTouch 2 and more."""
