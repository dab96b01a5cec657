"""What the views show by themselves: a new CT in all slices, a new skull in the middle of the 3-D view."""

from __future__ import annotations

from typing import Any

from CranioNavLib import scene


class ViewFollower:
    """Looks at the scene now and then; when the CT or the bone is another one, the views turn to it."""

    def __init__(self, slicer_app: Any) -> None:
        self._app = slicer_app
        self._shown: dict[str, tuple[str, int]] = {}

    def refresh(self) -> None:
        """Show what is new. Main thread only."""
        if self._is_new("CT", lambda node: node.GetImageData()):
            self._app.display_manager.show_volume_in_slice_background(scene.find("CT"))
            self._app.display_manager.reset_views()
        if self._is_new("Bone", lambda node: node.GetPolyData()):
            self._app.display_manager.reset_views()

    def _is_new(self, role: str, content: Any) -> bool:
        node = scene.find(role)
        data = content(node) if node is not None else None
        key = (node.GetID(), id(data)) if data is not None else ("", 0)
        changed = self._shown.get(role) != key
        self._shown[role] = key
        return changed and data is not None
