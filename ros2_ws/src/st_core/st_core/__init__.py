"""Single-track vehicle models, prediction and evaluation, without ROS. Callers supply the time and the text of files.

Start with `prediction.predict`, `log_evaluation.evaluate_log`, `checks.check` or `discovery.discover`.
The paper cited in docstrings: Aertssen et al., Short-Horizon Position Accuracy of Single-Track Models, AVEC 2026.
"""

__version__ = "0.2.0"
