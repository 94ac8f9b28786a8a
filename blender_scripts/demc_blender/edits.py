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
        """Sets a property and remembers its value. A property this Blender lacks is passed over. What animates or
        drives it is muted: it would set the property anew when the scene is evaluated."""
        if not hasattr(owner, name):
            return
        for curve in _animating(owner, name):
            if not curve.mute:
                curve.mute = True
                self.on_undo(lambda curve=curve: setattr(curve, "mute", False))
        old = getattr(owner, name)
        old = tuple(old) if hasattr(old, "__len__") and not isinstance(old, str) else old
        if old == value:
            return
        setattr(owner, name, value)
        self.on_undo(lambda: setattr(owner, name, old))

    def keep(self, owner, *names):
        """Remembers properties that change as others are set. They are put back in this order."""
        for name in reversed(names):
            value = getattr(owner, name)
            self.on_undo(lambda name=name, value=value: setattr(owner, name, value))

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


def _animating(owner, name):
    """The drivers and F-curves of a property."""
    animation = getattr(owner.id_data, "animation_data", None)
    if animation is None:
        return []
    try:
        path = owner.path_from_id(name)
    except (ValueError, AttributeError):  # what has no path cannot be animated
        return []
    return [curve for curve in (*animation.drivers, *_curves(animation)) if curve.data_path == path]


def _curves(animation):
    """The F-curves of an action, and of the strips of the non-linear animation."""
    strips = [strip for track in animation.nla_tracks for strip in track.strips]
    for user in (animation, *strips):
        action = user.action
        if action is None:
            continue
        if not hasattr(action, "layers"):  # Blender 4.3 and before
            yield from action.fcurves
            continue
        slot = user.action_slot
        bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
        for bag in bags:
            if slot is not None and bag.slot_handle == slot.handle:
                yield from bag.fcurves
