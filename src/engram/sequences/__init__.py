"""Readers of drives: images in known layouts, and frame logs."""
