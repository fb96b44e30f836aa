"""Vocabulary, Chow-Liu tree, FAB-MAP: an image → the places it may show."""
