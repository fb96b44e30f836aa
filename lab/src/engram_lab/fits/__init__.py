"""What found the constants that ship: `python -m engram_lab.fits.NAME`."""
