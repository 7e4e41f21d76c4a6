"""Entry point of `st`; Ctrl-C ends it without a traceback, even while modules are being imported."""

import gc
import signal


def main() -> None:
    gc.set_threshold(100_000)  # allocations; with the default of 700, collection takes a tenth of the time of a command
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from .cli import main as run

    signal.signal(signal.SIGINT, handler)
    run()


if __name__ == "__main__":
    main()
