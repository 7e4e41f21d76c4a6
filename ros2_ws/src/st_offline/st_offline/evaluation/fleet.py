"""Many runs: one after another here, or side by side through Dask, results coming in as they are done."""

import contextlib
from collections.abc import Callable, Iterator, Sequence

from st_recordings.runs import RunSource

from .work import Progress, RunReport, Task, evaluate_run

MEMORY_PER_WORKER = "1500MB"  # a worker that needs more is started anew, and its run is a failed one


class WorkersError(RuntimeError):
    """Workers that cannot be had; the text says why."""


def reports(sources: Sequence[RunSource], task: Task, workers: int, scheduler: str | None,
            progress: Callable[[RunSource], Progress] | None = None) -> Iterator[RunReport]:
    """One report per run; in order with one worker, else as they are done.

    scheduler: address of a Dask scheduler whose workers see the same files. Raises WorkersError.
    """
    if workers <= 1 and not scheduler:
        for source in sources:
            yield evaluate_run(source, task, progress(source) if progress else None)
        return
    try:
        from distributed import Client, LocalCluster, as_completed
    except ImportError:
        raise WorkersError("Dask is not installed: leave out --workers and --scheduler") from None
    with contextlib.ExitStack() as stack:
        try:
            cluster = scheduler or stack.enter_context(LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=MEMORY_PER_WORKER, dashboard_address=None,
                host="127.0.0.1", silence_logs=50))
            client = stack.enter_context(Client(cluster, timeout="10s"))
        except (OSError, TimeoutError) as error:
            raise WorkersError(f"no Dask scheduler at {scheduler or 'this machine'}: {error}") from None
        futures = {client.submit(evaluate_run, source, task, pure=False, retries=0): source for source in sources}
        for future in as_completed(futures):
            problem = future.exception()
            source = futures[future]
            yield future.result() if problem is None else RunReport(
                source.name, problem=f"{source.where}: the worker ended: {' '.join(str(problem).split())[:200]}")
            future.release()
