"""Trained touch encoders: load, embed, stream, export, adapt."""
