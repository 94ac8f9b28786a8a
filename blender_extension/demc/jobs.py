"""Work that goes on beside Blender: one worker process, followed without waiting for it.

A `Job` is started, polled and stopped. Operators poll it from a timer, scripts and background renders wait
for it; both end in the same state. The worker writes into files that are read as they grow: no thread waits
in a pipe, which Blender could not end with.
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time

import bpy

WAITING, RUNNING, DONE, FAILED, CANCELLED = "waiting", "running", "done", "failed", "cancelled"

# How long a cancelled worker may take to finish the file it is writing.
_GRACE_SECONDS = 3.0
# How often a script that waits looks.
_LOOK_SECONDS = 0.02

# The job that is running, or the last one: what the panel tells of.
_current = None
# Why Denoise After Render began none, where that came after the last one.
_refusal = None


class JobError(Exception):
    """Why there is nothing to denoise, in words for the user, and what to do."""


def current():
    """The job that is running or was the last, or None."""
    return _current


def refusal():
    """Why the last render was not denoised, where nothing has been since; or None."""
    return _refusal


def refuse(words):
    """Keeps why a render is not denoised, for the panel: no operator is at hand to report it."""
    global _refusal
    _refusal = words


def is_running():
    """Whether a job is under way."""
    return _current is not None and _current.state == RUNNING


def begin(job):
    """Starts a job; raises JobError while another is under way or where the worker cannot be started."""
    global _current
    if is_running():
        raise JobError(f"demc is at work ({_current.title}): wait for it, or cancel it first")
    job.start()
    _current = job
    refuse(None)


def abandon():
    """Ends what is running, and forgets it."""
    global _current
    if _current is not None:
        _current.kill()
    _current = None
    refuse(None)


class Job:
    """One run of `demc denoise` over some files."""

    def __init__(self, title, inputs, folder, options, total, picture=None, scene=None):
        """inputs: files, or one folder. folder: where results go. options: further arguments of the command.
        total: how many results are expected. picture: name of the added layer, where a single result is
        wanted as a plain picture too. scene: name of the scene that it is for."""
        self.title, self.inputs, self.folder, self.total = title, inputs, folder, total
        self.options, self.layer, self.scene = options, picture, scene
        self.state = WAITING
        self.results = []  # the objects of demc's JSON for files that are done, or were there
        self.skipped = self.outdated = 0  # results that were there, and how many of them are not as they would be now
        self.errors, self.notes = [], []
        self.picture = None
        self.scratch = []  # files and folders that are of no use when the job has ended
        self._process = self._stopped_at = None
        self._output = self._trouble = None
        self._rest = b""
        self._started = self._ended = 0.0

    @property
    def finished(self):
        """How many files are dealt with."""
        return len(self.results) + len(self.errors)

    @property
    def progress(self):
        """From 0 to 1."""
        return min(self.finished / self.total, 1.0) if self.total else 0.0

    @property
    def seconds(self):
        """For how long the job has been running, or ran."""
        return (self._ended or time.monotonic()) - self._started

    def start(self):
        """Starts the worker; raises JobError where there is none to start."""
        request = {
            "paths": _worker_paths(),
            "arguments": ["denoise", *self.inputs, "--out", self.folder, "--json", *self.options],
            "picture": self._wanted_picture(),
        }
        # What the worker says goes into files of its own, each open twice: here they are read from where they
        # were left.
        talk = tempfile.mkdtemp(prefix="demc-", dir=bpy.app.tempdir)
        self.scratch.append(talk)
        said, told = (open(os.path.join(talk, name), "wb") for name in ("output", "trouble"))
        self._output, self._trouble = (open(file.name, "rb") for file in (said, told))
        worker = os.path.join(os.path.dirname(os.path.abspath(__file__)), "worker.py")
        try:
            self._process = subprocess.Popen(
                # The first releases of 4.2 do not tell what Python is to be started with.
                [sys.executable, *getattr(bpy.app, "python_args", ()), worker],
                stdin=subprocess.PIPE, stdout=said, stderr=told,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
        except OSError as error:
            self._tidy()
            raise JobError(f"Blender's Python ({sys.executable}) does not start: {error}") from None
        finally:
            said.close()
            told.close()
        self._started = time.monotonic()
        self.state = RUNNING

    def poll(self):
        """Takes in what the worker has said. Returns whether it still runs."""
        if self.state != RUNNING:
            return False
        status = self._process.poll()
        if status is None:
            self._read()
            if self._stopped_at and time.monotonic() - self._stopped_at > _GRACE_SECONDS:
                self._process.kill()
            return True
        self._read()
        self._conclude(status)
        return False

    def wait(self):
        """Waits for the end."""
        while self.poll():
            time.sleep(_LOOK_SECONDS)
        return self

    def stop(self):
        """Asks the worker to end. `poll` tells when it has, and makes it where it does not."""
        if self.state == RUNNING and self._stopped_at is None:
            self._stopped_at = time.monotonic()
            self._process.stdin.close()

    def kill(self):
        """Ends the worker now."""
        if self.state == RUNNING:
            self._stopped_at = time.monotonic()
            self._process.kill()
            self._process.wait()
            self.poll()

    def summary(self):
        """The end in one line."""
        count = len(self.results) - self.skipped
        parts = [f"{count} {'frame' if count == 1 else 'frames'} denoised in {self.seconds:.1f} s"] if count else []
        if self.skipped:
            were = "result was" if self.skipped == 1 else "results were"
            other = f", {self.outdated} of an older render or other settings" if self.outdated else ""
            parts.append(f"{self.skipped} {were} there already{other} (Overwrite makes them again)")
        if self.errors:
            more = f", and {len(self.errors) - 1} more failed" if len(self.errors) > 1 else ""
            parts.append(f"failed: {self.errors[0]}{more}")
        if self.state == CANCELLED:
            parts.insert(0, "Cancelled")
        return "; ".join(parts) or "nothing was denoised"

    def _wanted_picture(self):
        if self.layer is None:
            return None
        result = os.path.join(self.folder, os.path.basename(self.inputs[0]))
        return {"of": result, "noisy": self.inputs[0], "layer": self.layer, "as": f"{os.path.splitext(result)[0]}_denoised.exr"}

    def _read(self):
        lines = (self._rest + self._output.read()).split(b"\n")
        self._rest = lines.pop()
        for line in lines:
            self._take(line)

    def _take(self, line):
        try:
            said = json.loads(line)
        except ValueError:
            return
        if "picture" in said:
            self.picture = said["picture"]
        elif "no_picture" in said:
            self.notes.append(f"no plain picture: {said['no_picture']}")
        elif said.get("status") == "failed":
            self.errors.append(said.get("error", "unknown"))
        elif "status" in said:
            self.results.append(said)
            notes = said.get("notes") or []
            if said["status"] == "skipped":
                self.skipped += 1
                self.outdated += bool(notes)
            else:
                self.notes += notes

    def _conclude(self, status):
        self._ended = time.monotonic()
        if self._stopped_at and status != 0:
            self.state = CANCELLED
        elif status == 0:
            self.state = DONE
        else:
            self.state = FAILED
            if not self.errors:
                self.errors.append(self._last_words(status))
        self._tidy()

    def _last_words(self, status):
        self._trouble.seek(0)
        lines = self._trouble.read().decode(errors="replace").split("\n")
        told = [line.removeprefix("demc: ").removeprefix("error: ") for line in lines if line.strip()]
        return told[-1] if told else f"the worker ended with status {status} and said nothing"

    def _tidy(self):
        if self._process and self._process.stdin and not self._process.stdin.closed:
            try:
                self._process.stdin.close()
            except OSError:
                pass  # the worker is gone already
        for file in (self._output, self._trouble):
            file.close()
        for path in self.scratch:
            if os.path.isdir(path):
                shutil.rmtree(path, ignore_errors=True)
            elif os.path.exists(path):
                os.remove(path)


def _worker_paths():
    """Where the worker finds demc and numpy. Neither is imported here: what fails in them fails in the
    worker."""
    folders = []
    for name in ("demc", "numpy"):
        spec = importlib.util.find_spec(name)
        if spec is None or not spec.submodule_search_locations:
            raise JobError(f"The Python package {name} is missing: remove the extension and install it again")
        folders.append(os.path.dirname(os.path.abspath(spec.submodule_search_locations[0])))
    return list(dict.fromkeys(folders))
