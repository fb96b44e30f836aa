"""Frames of a drive → what is wrong with it, before anything is mapped."""
