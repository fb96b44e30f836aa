"""One side of `engram lab bench --against`: runs blocks of a stage by the code on its path.

Run as a file, so that a checkout from before this module can be the other side. For each line
"STAGE RUNS" of its input it answers with the seconds of processor time of that many runs.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter

if __name__ == "__main__":
    import cv2

    import engram
    from engram_lab.bench.data import load_bench_data
    from engram_lab.bench.stages import STAGES

    cv2.setNumThreads(1)
    if sys.platform == "linux":
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    data, runs, done = load_bench_data(), {}, Counter[str]()
    print(engram.__file__, flush=True)
    for line in sys.stdin:
        name, count = line.split()
        if name not in runs:
            runs[name] = STAGES[name](data, None).ours
        started = time.process_time()
        for _ in range(int(count)):
            runs[name](done[name])
            done[name] += 1
        print(time.process_time() - started, flush=True)
