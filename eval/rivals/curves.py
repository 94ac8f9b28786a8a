"""Joins the logs of runs of train.sh into one table and one chart: how fast each method learned.

    python curves.py OUT [NAME...]

reads OUT/NAME/log.csv of each method (of those that are there, if none is named), and OUT/NAME.seconds, the processor time of the whole run, over which the log's
seconds are spread where it is there (a run may have waited for others); and writes, beside this script, curves.csv (run, step, seconds, lr,
train_loss, val_relmse, val_ssim) and curves.svg: RelMSE of the scenes that were held out, over steps and over
minutes of one thread. Needs matplotlib.
"""

import csv
import os
import sys

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "demc"})
import matplotlib.pyplot as plt
from matplotlib.ticker import NullFormatter, ScalarFormatter

METHODS = ("demc", "demc-nofusion", "semc", "kpcn", "kpcn-combined", "lbf")
COLUMNS = ("step", "seconds", "lr", "train_loss", "val_relmse", "val_ssim")


def read(out, name):
    """The rows of a run's log."""
    with open(os.path.join(out, name, "log.csv"), encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    try:
        with open(os.path.join(out, name + ".seconds"), encoding="utf-8") as file:
            factor = float(file.read()) / float(rows[-1]["seconds"])
    except FileNotFoundError:
        return rows
    return [row | {"seconds": f"{factor * float(row['seconds']):.1f}"} for row in rows]


def draw(logs, path):
    """One curve a method, over steps on the left and over minutes on the right."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True, constrained_layout=True)
    scales = ((axes[0], "step", 1, "steps"), (axes[1], "seconds", 60, "minutes of one thread, validation included"))
    for axis, column, unit, label in scales:
        for name, rows in logs.items():
            x = [float(row[column]) / unit for row in rows]
            axis.plot(x, [float(row["val_relmse"]) for row in rows], marker=".", label=name)
        axis.set(xscale="log", yscale="log", xlabel=label)
        axis.grid(alpha=0.3, which="both")
        for ticks in (axis.xaxis, axis.yaxis):
            ticks.set_major_formatter(ScalarFormatter())
        axis.yaxis.set_minor_formatter(ScalarFormatter())
        axis.xaxis.set_minor_formatter(NullFormatter())
    axes[0].set_ylabel("RelMSE, held-out scenes")
    axes[1].legend(frameon=False)
    figure.savefig(path, metadata={"Date": None})


def main():
    """Entry point of the script."""
    if len(sys.argv) < 2:
        sys.exit("usage: python curves.py OUT [NAME...]")
    out, names = sys.argv[1], sys.argv[2:]
    names = names or [name for name in METHODS if os.path.exists(os.path.join(out, name, "log.csv"))]
    logs = {name: read(out, name) for name in names}
    here = os.path.dirname(os.path.abspath(__file__))
    with open(os.path.join(here, "curves.csv"), "w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("run", *COLUMNS))
        table.writerows([name, *(row[column] for column in COLUMNS)] for name, rows in logs.items() for row in rows)
    draw(logs, os.path.join(here, "curves.svg"))


if __name__ == "__main__":
    main()
