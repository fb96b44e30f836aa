"""Damaged and hostile files: what reads them must refuse them or read them, and nothing else.

`samples` makes sound files, `bytewise`, `rowwise`, `definitions` and `handins` change them,
`reading` does with a changed file what users do, `forks` does it in a child with limits.
"""
