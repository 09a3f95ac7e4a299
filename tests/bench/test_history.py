"""The history of reports: entries are added, none is changed, numbers are those of the report."""

import json

from tests.bench import history


def row(task, setting, time, error):
    return {"task": task, "family": "ours", "setting": setting, "us/pixel": time, "with gradient": None,
            "relative RMSE": error, "first call s": 3.0}  # fmt: skip


def test_a_report_becomes_the_last_entry(tmp_path):
    path = tmp_path / "history.json"
    path.write_text('[{"date": "2026-01-01"}]\n')
    rows = [
        row("a room", "degree 4", 1.23456, 0.0123456),
        row("a room", "degree 8", 2.0, 1e-3),
        row("a sun", "one", 4.0, 0.0),
    ]
    history.remember({"machine": "2 cores", "rows": rows}, path)
    first, last = json.loads(path.read_text())
    assert first == {"date": "2026-01-01"}
    assert last["tasks"]["a room"] == {"ours, degree 4": [1.23, None, 0.0123], "ours, degree 8": [2.0, None, 0.001]}
    assert last["tasks"]["a sun"] == {"ours, one": [4.0, None, 0.0]} and last["machine"] == "2 cores"


def test_the_stored_history_has_one_form():
    entries = json.loads(history.HISTORY.read_text())
    assert entries and [e["date"] for e in entries] == sorted(e["date"] for e in entries)
    for entry in entries:
        rows = [numbers for task in entry["tasks"].values() for numbers in task.values()]
        assert rows and all(len(numbers) == len(entry["columns"]) for numbers in rows)
