"""A worker lists its jobs, then answers each line that names one with the seconds of one run.

The driver keeps every worker alive and gives them turns, so that all measure the same machine.
"""

import json
import sys
import time


def serve(jobs, facts):
    """Serves `jobs` (name -> function making a function without arguments) on stdin and stdout."""
    print(json.dumps({"jobs": list(jobs), **facts}), flush=True)
    ready = {}
    for line in sys.stdin:
        name = line.strip()
        if name not in jobs:
            print(f"no job '{name}'", flush=True)
            continue
        if name not in ready:
            ready[name] = jobs[name]()
        start = time.perf_counter()
        seconds = ready[name]()
        # A job that runs a program of its own reports that program's time.
        print(time.perf_counter() - start if seconds is None else seconds, flush=True)
