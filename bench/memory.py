"""Memory and processor load of every process of the suite over ten minutes at 250 Hz NCOM and full CAN rate.

ST_BENCH_MINUTES sets another duration. Memory is resident memory, after one minute and at the end.
"""

import os
import time

import psutil

from ._suite import run_suite


def run() -> dict:
    minutes = float(os.environ.get("ST_BENCH_MINUTES", "10"))
    result: dict = {"minutes": minutes}
    with run_suite(minutes * 60 + 20) as suite:
        processes = {child.name: psutil.Process(child.process.pid) for child in suite.children}
        time.sleep(60)
        first = {name: p.memory_info().rss / 2**20 for name, p in processes.items()}
        cpu = {name: sum(p.cpu_times()[:2]) for name, p in processes.items()}
        time.sleep(max(0.0, minutes * 60 - 60))
        seconds = minutes * 60 - 60
        for name, process in processes.items():
            load = (sum(process.cpu_times()[:2]) - cpu[name]) / seconds if seconds else float("nan")
            result[name] = {
                "memory_mb_1_min": first[name],
                "memory_mb_end": process.memory_info().rss / 2**20,
                "cpu_share_of_a_core": load,
                "open_files": process.num_fds(),
            }
    return result
