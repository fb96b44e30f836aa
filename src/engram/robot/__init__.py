"""Whole drives: open, replay, record, map, localise, summarise. Imported when first used."""
