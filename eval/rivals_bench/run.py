#!/usr/bin/env python3
"""demc beside torch, ONNX Runtime and Open Image Denoise: one run, every program in its turn.

    pip install -r eval/rivals_bench/requirements.txt
    python eval/rivals_bench/run.py --oidn PATH/oidnDenoise --out eval/speed

Each round runs every job of every program once; the first round warms up, medians of the others count.
A program that is not installed is left out and said so. Writes rivals.csv, every_run.csv and README.md.
"""

import argparse
import csv
import json
import os
import platform
import statistics
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent

# Heading, size of the job's name it begins with, and the run that the others are measured by.
TASKS = {
    "training step, base 16, 8 crops of 128x128": ("train base16", "torch", "f32"),
    "inference, base 16, 1280x720": ("infer base16", "onnxruntime", "f32"),
    "built-in models, 1280x720": ("1280x720", "oidnDenoise", "oidn-high"),
    "built-in models, 1920x1080": ("1920x1080", "oidnDenoise", "oidn-high"),
}


class Worker:
    """A program kept alive between its turns."""

    def __init__(self, name, command, threads):
        environment = {**os.environ, "RAYON_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)}
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment
        )
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{name} does not start; {' '.join(map(str, command))} says why")
        self.name, self.facts = name, json.loads(line)
        self.jobs = self.facts["jobs"]

    def run(self, job):
        self.process.stdin.write(job + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline().strip()
        try:
            return float(answer)
        except ValueError:
            raise RuntimeError(f"{self.name}: {job}: {answer or 'ended'}") from None


def start(args):
    small = ["--small"] if args.small else []
    threads = ["--threads", str(args.threads)]
    commands = {"demc": ["cargo", "bench", "-q", "--bench", "network", "--", "--worker", *small]}
    for name, script in (("torch", "torch_worker.py"), ("onnxruntime", "onnx_worker.py")):
        commands[name] = [sys.executable, HERE / script, *threads, *small]
    if args.oidn:
        commands["oidnDenoise"] = [sys.executable, HERE / "oidn_worker.py", "--program", args.oidn, *threads, *small]
    workers = []
    for name, command in commands.items():
        try:
            workers.append(Worker(name, command, args.threads))
        except RuntimeError as error:
            if name == "demc":
                raise
            print(f"left out: {error}", file=sys.stderr)
    counts = {w.name: w.facts["parameters"] for w in workers if "parameters" in w.facts}
    if len(set(counts.values())) != 1:
        raise SystemExit(f"these are not one network: parameters {counts}")
    return workers


def measure(workers, args):
    """Seconds of every timed run, by (program, job)."""
    times = {(w.name, job): [] for w in workers for job in w.jobs if args.only in job and "peak" not in job}
    by_name = {w.name: w for w in workers}
    # Jobs of one task follow each other: what is compared is measured within seconds.
    order = sorted(times, key=lambda key: [prefix not in key[1] for prefix, _, _ in TASKS.values()])
    for turn in range(args.rounds + 1):
        print(f"round {turn} of {args.rounds}", file=sys.stderr)
        for program, job in order:
            seconds = by_name[program].run(job)
            if turn > 0:
                times[program, job].append(seconds)
    return times


def cpu():
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def table(times):
    """Rows of rivals.csv: every job of a task, and its ratio to the run that the task is measured by."""
    rows = []
    for task, (prefix, rival, base) in TASKS.items():
        of_task = {key: statistics.median(runs) for key, runs in times.items() if prefix in key[1] and runs}
        baseline = next((s for (p, job), s in of_task.items() if p == rival and base in job), None)
        for (program, job), seconds in of_task.items():
            rows.append(
                {
                    "task": task,
                    "program": program,
                    "job": job,
                    "median_ms": f"{seconds * 1e3:.3f}",
                    "fastest_ms": f"{min(times[program, job]) * 1e3:.3f}",
                    "rounds": len(times[program, job]),
                    "ratio": f"{seconds / baseline:.4f}" if baseline else "",
                }
            )
    return rows


def readme(rows, workers, args):
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=ROOT)
    programs = ", ".join(w.facts["program"] for w in workers if "program" in w.facts)
    lines = [
        "# Speed beside the rivals",
        "",
        f"`python {' '.join(['eval/rivals_bench/run.py', *sys.argv[1:]])}` at commit {commit.stdout.strip()};",
        f"{args.threads} threads of {cpu()}; {programs}.",
        f"Medians of {args.rounds} rounds in which all programs took turns.",
        "`ratio` is the time over that of the run marked 1.00: torch's f32 step, ONNX Runtime's f32 inference,",
        "Open Image Denoise's quality high. Every run is in `every_run.csv`.",
    ]
    for task in TASKS:
        of_task = [row for row in rows if row["task"] == task]
        if of_task:
            lines += ["", f"## {task[0].upper()}{task[1:]}", "", "| program | run | ms | ratio |", "|---|---|---|---|"]
        for row in sorted(of_task, key=lambda row: float(row["median_ms"])):
            ratio = f"{float(row['ratio']):.2f}" if row["ratio"] else ""
            lines.append(f"| {row['program']} | {row['job']} | {float(row['median_ms']):.1f} | {ratio} |")
    return "\n".join(lines) + "\n"


def write_csv(path, rows):
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("eval/speed"))
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--oidn", help="the program oidnDenoise", default=os.environ.get("OIDN_DENOISE"))
    parser.add_argument("--only", default="", help="only jobs whose name holds this")
    parser.add_argument("--small", action="store_true", help="tiny sizes: to test the scripts, not to time")
    args = parser.parse_args()
    workers = start(args)
    times = measure(workers, args)
    rows = table(times)
    if not rows:
        raise SystemExit("no job was timed; see --only")
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "rivals.csv", rows)
    runs = [
        {"program": program, "job": job, "round": i + 1, "seconds": f"{seconds:.6f}"}
        for (program, job), all_runs in times.items()
        for i, seconds in enumerate(all_runs)
    ]
    write_csv(args.out / "every_run.csv", runs)
    (args.out / "README.md").write_text(readme(rows, workers, args))
    print((args.out / "README.md").read_text())


if __name__ == "__main__":
    main()
