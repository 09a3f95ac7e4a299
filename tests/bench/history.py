"""What earlier reports measured, in docs/history.json: python -m tests.bench.history output/report/report.json.

One entry for every report whose tables went to the pages: when, with which versions, on which machine, and for every
task and method its time, that with the gradient, and its error. Times of different machines do not compare; their
ratios, and errors, do.
"""

import datetime
import json
import sys
from pathlib import Path

import shisd
from shisd.io.internal import write_atomically

HISTORY = Path(__file__).resolve().parents[2] / "docs" / "history.json"


def entry(report: dict) -> dict:
    """A report, cut to what is compared later; numbers to three digits."""
    short = lambda x: float(f"{x:.3g}") if isinstance(x, float) else x
    tasks: dict[str, dict[str, list]] = {}
    for row in report["rows"]:
        (time,) = (key for key in row if key.startswith("us/"))
        numbers = [short(row[key]) for key in (time, "with gradient", "relative RMSE")]
        tasks.setdefault(row["task"], {})[f"{row['family']}, {row['setting']}"] = numbers
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    columns = ["us", "us with gradient", "relative RMSE"]
    return {"date": today, "shisd": shisd.__version__, "machine": report["machine"], "columns": columns, "tasks": tasks}


def remember(report: dict, path: Path = HISTORY) -> None:
    """Adds an entry as the last."""
    entries = json.loads(path.read_text()) if path.exists() else []
    write_atomically(path, json.dumps([*entries, entry(report)], indent=1) + "\n", overwrite=True)


if __name__ == "__main__":
    remember(json.loads(Path(sys.argv[1]).read_text()))
