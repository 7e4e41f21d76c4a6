"""Order of importance on a busy computer: bridges and predictor, then recorder and evaluator, then the view.

The first may get real-time scheduling (`st live --realtime`), where this computer's limits allow it. The others lower
themselves once they have started (st_ros.scheduling.lower).
"""

import os

# Priorities of SCHED_RR: above other programs, far below the kernel's own threads (50 and more). A bridge stamps and
# hands on in a millisecond what the predictor then needs.
REALTIME = {"oxts_bridge": 22, "canedge_bridge": 22, "predictor": 21}
VIEW_NICE = 15  # a thirtieth of an equal share

HOW_TO_ALLOW = 'echo "$USER - rtprio 30" | sudo tee /etc/security/limits.d/single-track.conf, then log in again'


def make_realtime(pid: int, name: str) -> bool:
    """Real-time scheduling for a process that has just started, if it is one of REALTIME; False where not allowed.

    pid: of the process. name: of the node, or of another process of the suite.
    """
    if name not in REALTIME:
        return True
    try:
        os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(REALTIME[name]))
    except PermissionError:
        return False
    except ProcessLookupError:
        pass  # it has ended already, which others tell
    return True
