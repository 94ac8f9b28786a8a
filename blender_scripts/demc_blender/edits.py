"""Changes to the open scene that can be taken back.

The export must leave a user's scene as it found it, even when it runs inside an open Blender. Every
change therefore goes through one `Edits` object, which undoes them in reverse order.
"""

from contextlib import AbstractContextManager


class Edits(AbstractContextManager):
    """Remembers what was changed; leaving the `with` block undoes it, last change first."""

    def __init__(self):
        self._undo = []

    def set(self, owner, name, value):
        """Sets a property and remembers its value. A property this Blender lacks is passed over."""
        if not hasattr(owner, name):
            return
        old = getattr(owner, name)
        old = tuple(old) if hasattr(old, "__len__") and not isinstance(old, str) else old
        if old == value:
            return
        setattr(owner, name, value)
        self.on_undo(lambda: setattr(owner, name, old))

    def on_undo(self, action):
        """Registers what takes back a change that is no plain property."""
        self._undo.append(action)

    def undo(self):
        """Takes every change back. Data that is gone by now needs no undoing."""
        while self._undo:
            try:
                self._undo.pop()()
            except (ReferenceError, RuntimeError, AttributeError, TypeError):
                continue

    def __exit__(self, *_):
        self.undo()
        return False
