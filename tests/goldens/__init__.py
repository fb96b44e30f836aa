"""Goldens: what Engram finds on fixed drives, to the bit, so that a change of none can be shown.

    python -m tests.goldens check                 # everything, as this process computes it
    python -m tests.goldens check --all           # the same by every instruction set, with and
                                                  # without threads (`make goldens`)
    python -m tests.goldens check --only kitti    # one group; or one case, such as kitti/merge
    python -m tests.goldens make [--only NAME]    # writes the goldens of the code as it is
    python -m tests.goldens time --against OTHER  # time against another checkout of Engram

Make them again only for a change of result that is wanted, in a commit of its own that says what
became more accurate.

Groups of cases, each one JSON file here:

- ``street``: twelve pairs of a street of planes; needs nothing;
- ``kitti``, ``raw``, ``euroc``: the real clips that ``ENGRAM_DATA`` names;
- ``hamlet``: four drives through the simulated hamlet. They are rendered once into
  ``$ENGRAM_CAMPAIGNS`` or the user's cache (about a minute) and kept as frame logs by version of
  the world; logs of another front-end or odometry are refused.

A case holds rows, one per frame, and values. Where bits are compared, a column holds four
hexadecimal digits of SHA-256: over the float64 matrix of a pose, its covariance, a distance.
``pose`` is readable: translation in metres and rotation vector in radians of the live camera in its
node or of the frame in the one before. Of maps there are counts and `record_hashes`: every row of
every table, without what a revision tells of itself (author, message, version, configuration).

Bits depend on NumPy, SciPy, OpenCV and on the processor by which they choose their kernels.
``fingerprint.json`` tells where these goldens were made. Where it differs, statuses, nodes,
attempts and counts are compared exactly, poses to 1e-6, hashes not at all; and it is said.

`time` runs each checkout by its own ``through.py``. On a machine that does other things too, ask
for more blocks.

``through.py`` alone imports Engram and its lab: whoever moves a package follows there.
"""
