"""What moves is drawn over a kept picture: it must look as if all had been drawn anew."""

from __future__ import annotations

import asyncio
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from vtkmodules.vtkFiltersSources import vtkConeSource, vtkSphereSource
from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkRenderer, vtkRenderWindow, vtkRenderWindowInteractor

from Workstation.web.moving import MovingPicture
from Workstation.web.pacing import PacedRendering, Painter
from Workstation.web.pictures import HEADER, MOST_ON_THEIR_WAY, Pictures, Viewer


def actor_of(mesh: Any, color: tuple[float, float, float]) -> Any:
    mapper, actor = vtkPolyDataMapper(), vtkActor()
    mapper.SetInputData(mesh)
    actor.SetMapper(mapper)
    actor.GetProperty().SetColor(*color)
    return actor


def mesh_of(source: Any) -> Any:
    source.Update()
    return source.GetOutput()


class View:
    """A 3-D view with a skull of a kind."""

    def __init__(self) -> None:
        self._window, self._renderer = vtkRenderWindow(), vtkRenderer()
        self._window.SetOffScreenRendering(1)
        self._window.SetMultiSamples(0)
        self._window.SetSize(200, 160)
        self._window.AddRenderer(self._renderer)
        self._interactor = vtkRenderWindowInteractor()
        self._interactor.SetRenderWindow(self._window)
        self.rendered = 0
        self._window.AddObserver("EndEvent", self._count)
        sphere = vtkSphereSource()
        sphere.SetRadius(60)
        sphere.SetThetaResolution(60)
        sphere.SetPhiResolution(60)
        self.skull = actor_of(mesh_of(sphere), (0.9, 0.9, 0.8))
        self._renderer.AddActor(self.skull)
        self._renderer.ResetCamera()

    def _count(self, *_: Any) -> None:
        self.rendered += 1

    def render_window(self) -> Any:
        return self._window

    def renderer(self) -> Any:
        return self._renderer


class Tool:
    """A model node of a tool."""

    def __init__(self, x: float, y: float, z: float) -> None:
        cone = vtkConeSource()
        cone.SetHeight(50)
        cone.SetRadius(12)
        cone.SetCenter(x, y, z)
        self.mesh, self.visible = mesh_of(cone), True

    def GetDisplayNode(self) -> Any:
        return SimpleNamespace(
            GetVisibility=lambda: self.visible,
            GetColor=lambda: (0.9, 0.6, 0.0),
            GetOpacity=lambda: 1.0,
            GetRepresentation=lambda: 2,
        )

    def GetPolyData(self) -> Any:
        return self.mesh

    def GetID(self) -> str:
        return "tool"

    def GetParentTransformNode(self) -> None:
        return None


def drawn_anew(tool: Tool) -> Any:
    """The truth: skull and tool in one renderer."""
    view = View()
    camera = view.renderer().GetActiveCamera().__class__()
    camera.DeepCopy(view.renderer().GetActiveCamera())
    view.renderer().AddActor(actor_of(tool.mesh, (0.9, 0.6, 0.0)))
    view.renderer().SetActiveCamera(camera)
    view.renderer().ResetCameraClippingRange()
    return MovingPicture(view, list).draw().astype(int)


@pytest.mark.parametrize("place", [(0.0, 0.0, 80.0), (55.0, 10.0, 0.0), (0.0, 0.0, -80.0), (40.0, 40.0, 40.0)])
def test_a_tool_before_in_and_behind_the_skull_looks_as_if_drawn_with_it(place):
    tool, view = Tool(*place), View()
    picture = MovingPicture(view, lambda: [tool]).draw()
    assert picture.shape == (160, 200, 3)
    differs = np.abs(picture.astype(int) - drawn_anew(tool)).max(axis=2) > 40
    assert differs.mean() < 0.005


def test_a_tool_that_moves_leaves_the_rest_undrawn():
    tool, view = Tool(0, 0, 80), View()
    pictures = MovingPicture(view, lambda: [tool])
    first = pictures.draw()
    tool.mesh = Tool(30, 0, 80).mesh
    assert (pictures.draw() != first).any()
    assert view.rendered == 1
    view.renderer().GetActiveCamera().Azimuth(30)
    pictures.draw()
    assert view.rendered == 2
    view.skull.GetProperty().SetColor(1.0, 0.0, 0.0)
    assert pictures.draw().max() == 255
    assert view.rendered == 3
    tool.visible = False
    pictures.draw()
    assert view.rendered == 4
    pictures.forget()
    pictures.draw()
    assert view.rendered == 5


class Source:
    """Stands in for what draws a view."""

    def __init__(self, name: str, painted: list[str]) -> None:
        self.name, self.painted, self.forgotten = name, painted, 0

    def draw(self) -> Any:
        self.painted.append(self.name)
        return np.zeros((4, 6, 3), np.uint8)

    def forget(self) -> None:
        self.forgotten += 1


class Window:
    """Stands in for a browser window's socket: draws what it gets at once, or what `draws` lets it."""

    def __init__(self, pictures: Pictures, draws: Any = lambda area: True) -> None:
        self.viewer, self.pictures, self.draws = Viewer(self), pictures, draws
        pictures._viewers.add(self.viewer)

    async def send_bytes(self, data: bytes) -> None:
        number, length = HEADER.unpack_from(data)
        area = data[HEADER.size : HEADER.size + length].decode()
        if self.draws(area):
            self.viewer.drew(area, number)
            self.pictures.freed()

    async def send_str(self, text: str) -> None:
        pass


def painted_of(ask: Any, seconds: float = 0.2, draws: Any = lambda area: True) -> list[str]:
    """What is painted while `ask(views, painter)` runs and a little longer, and a window draws what `draws` lets it."""
    painted: list[str] = []

    async def run() -> None:
        painter = Painter(Pictures())
        views = {name: PacedRendering(name, Source(name, painted), painter, 90) for name in "abc"}
        window = Window(painter.pictures, draws)
        tasks = [asyncio.create_task(painter.run()), asyncio.create_task(window.viewer.send(list))]
        await asyncio.sleep(0)
        await ask(views, painter)
        await asyncio.sleep(seconds)
        for task in tasks:
            task.cancel()

    asyncio.run(run())
    return painted


def test_many_requests_become_one_picture():
    async def ask(views: Any, _: Any) -> None:
        for _ in range(100):
            views["a"].schedule_render()

    assert painted_of(ask) == ["a"]


def test_no_view_keeps_the_others_from_being_painted():
    async def ask(views: Any, _: Any) -> None:
        for _ in range(60):
            for name in "aaabc":
                views[name].schedule_render()
            await asyncio.sleep(0.005)

    painted = painted_of(ask)
    counts = [painted.count(name) for name in "abc"]
    assert max(counts) - min(counts) <= 1
    assert min(counts) >= 2


def test_what_the_round_brings_into_the_scene_is_in_its_pictures():
    order: list[str] = []

    async def ask(views: Any, painter: Any) -> None:
        views["a"].source.painted = order

        def lead() -> None:
            order.append("lead")
            views["a"].schedule_render()

        painter.before_round = lead
        views["b"].schedule_render()

    painted_of(ask, 0.05)
    assert order[:2] == ["lead", "a"]


def test_quick_views_do_not_wait_for_slow_ones():
    async def ask(views: Any, _: Any) -> None:
        draw = views["b"].source.draw
        views["b"].source.draw = lambda: time.sleep(0.03) or draw()
        for _ in range(3):
            for name in "abc":
                views[name].schedule_render()
            await asyncio.sleep(0.15)

    painted = painted_of(ask)
    assert painted[:3] == ["a", "b", "c"]  # nothing is known of them yet
    assert painted[5:6] == painted[8:9] == ["b"]


def test_a_defect_in_one_view_stops_neither_the_others_nor_itself():
    async def ask(views: Any, _: Any) -> None:
        draw = views["a"].source.draw
        views["a"].source.draw = lambda: 1 // 0
        views["a"].schedule_render()
        views["b"].schedule_render()
        await asyncio.sleep(0.1)
        views["a"].source.draw = draw
        views["a"].schedule_render()

    assert painted_of(ask) == ["b", "a"]


def test_nothing_is_painted_for_what_is_not_to_be_seen_or_cannot_be_shown():
    async def ask(views: Any, painter: Any) -> None:
        painter.muted = True
        views["a"].schedule_render()
        painter.muted = False
        for _ in range(8):
            views["b"].schedule_render()
            await asyncio.sleep(0.05)
        views["c"].schedule_render()

    assert painted_of(ask, draws=lambda area: area != "b") == ["b"] * MOST_ON_THEIR_WAY + ["c"]


@pytest.mark.parametrize(("place", "deeds"), [((), ["ring gone"]), (("a tip",), ["followed"])])
def test_what_follows_a_tool_does_so_in_navigation_alone(place, deeds):
    from Workstation.web.application import WorkstationApp

    done: list[str] = []
    views = SimpleNamespace(hide_large=bool, ring=lambda tip, error: done.append("ring gone" if tip is error is None else "ring"))
    app = SimpleNamespace(
        views=views,
        painter=Painter(Pictures()),
        _place=("another tip",),
        _moved_s=0.0,
        _poll=bool,
        _followed=lambda: place,
        _navigate=lambda: done.append("followed"),
        _draw_moving=bool,
    )
    WorkstationApp._lead(app)
    assert done == deeds
    WorkstationApp._lead(app)
    assert done == deeds  # nothing has moved since


def test_only_what_stands_still_makes_a_kept_picture_old():
    painter, source = Painter(Pictures()), Source("a", [])
    view = PacedRendering("a", source, painter, 90)
    with painter.while_moving():
        view.schedule_render()
    assert not source.forgotten
    view.schedule_render()
    assert source.forgotten == 1
