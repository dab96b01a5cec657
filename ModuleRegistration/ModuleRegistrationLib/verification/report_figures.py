"""Pictures of a registered case: the skull with its points, the error to expect, slices, A-lines. PNG bytes."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from CranioNavLib.rigid import Array, transform_points
from CranioNavLib.surface import Surface

if TYPE_CHECKING:
    from ModuleRegistrationLib.procedure import CaseResult

BONE_COLOR = "#e8e0cf"
# camera direction from the head's middle, and what is up, in RAS
VIEWS = {
    "front": ((0, 1, 0.15), (0, 0, 1)),
    "left": ((-1, 0.25, 0.1), (0, 0, 1)),
    "right": ((1, 0.25, 0.1), (0, 0, 1)),
    "top": ((0, 0, 1), (0, 1, 0)),
}
VIEW_PIXELS = 430
RESIDUAL_COLORS = "RdBu_r"  # told apart by the colour-blind too
MAP_TRIANGLES = 40_000  # enough for a colour map that a report shows at 430 pixels


def skull_with_points(result: CaseResult) -> bytes:
    """Four views of the skull; bone points coloured by their signed distance to the surface, targets as rings."""
    import pyvista

    scene = _Views(result.bone.closed)
    registration = result.registration
    cloud, limits = None, (-0.5, 0.5)
    if len(result.points):
        cloud = pyvista.PolyData(registration.points_ras_mm)
        cloud["residual (mm)"] = registration.residuals_mm
        widest = float(np.ceil(2 * np.abs(registration.residuals_mm).max()) / 2)
        limits = (-max(widest, 0.5), max(widest, 0.5))
    landmarks = transform_points(registration.reference_to_ras, result.landmarks_patient_mm)
    for plotter in scene.each():
        scene.add_bone(plotter)
        if cloud is not None:
            balls = cloud.glyph(geom=pyvista.Sphere(radius=3.0), scale=False, orient=False)
            plotter.add_mesh(balls, scalars="residual (mm)", cmap=RESIDUAL_COLORS, clim=limits, show_scalar_bar=False, ambient=0.4)
        _add_balls(plotter, landmarks, 2.4, "#e69f00")
        if result.case.targets_ct is not None:
            _add_balls(plotter, result.targets_ras_mm, 2.2, "#009e73")
    title = "distance of a point to the bone surface (mm), + outside" if cloud is not None else None
    return scene.picture((RESIDUAL_COLORS, limits, title) if title else None)


def error_map(result: CaseResult) -> bytes | None:
    """Four views of the skull coloured by the 95% error to expect; None where the method gives no uncertainty."""
    from ModuleRegistrationLib.registration.error_theory import predict_tre_of

    if result.registration.covariance is None:
        return None
    scene = _Views(result.bone.closed, MAP_TRIANGLES)
    p95 = predict_tre_of(result.registration, np.asarray(scene.mesh.points)).p95_mm
    scene.mesh["95% error (mm)"] = p95
    limits = (0.0, float(np.ceil(2 * p95.max()) / 2))
    for plotter in scene.each():
        plotter.add_mesh(
            scene.mesh, scalars="95% error (mm)", cmap="viridis", clim=limits, smooth_shading=True, show_scalar_bar=False
        )
    return scene.picture(color_bar=("viridis", limits, "95% error to expect (mm)"))


def _add_balls(plotter: Any, positions: Array, radius: float, color: str) -> None:
    import pyvista

    if len(positions):
        plotter.add_mesh(
            pyvista.PolyData(positions).glyph(geom=pyvista.Sphere(radius=radius), scale=False, orient=False), color=color
        )


class _Views:
    """Four views of one mesh, side by side."""

    def __init__(self, surface: Surface, triangles: int = 150_000) -> None:
        import pyvista

        mesh = pyvista.wrap(surface.to_polydata())
        if mesh.n_cells > triangles:
            mesh = mesh.decimate(1 - triangles / mesh.n_cells)
        self.mesh = mesh.compute_normals(auto_orient_normals=False, split_vertices=False)
        self._plotter = pyvista.Plotter(
            off_screen=True, shape=(1, len(VIEWS)), border=False, window_size=(VIEW_PIXELS * len(VIEWS), VIEW_PIXELS)
        )

    def each(self) -> Any:
        """The plotter, set to each view in turn."""
        middle, size = self.mesh.center, self.mesh.length
        for column, (name, (direction, up)) in enumerate(VIEWS.items()):
            self._plotter.subplot(0, column)
            self._plotter.set_background("white")
            yield self._plotter
            self._plotter.add_text(name, position="upper_left", font_size=9, color="#444444")
            self._plotter.camera.parallel_projection = True
            self._plotter.camera.focal_point = middle
            self._plotter.camera.position = np.add(middle, np.multiply(direction, 2 * size))
            self._plotter.camera.up = up
            self._plotter.camera.parallel_scale = 0.36 * size
            self._plotter.reset_camera_clipping_range()

    def add_bone(self, plotter: Any) -> None:
        plotter.add_mesh(self.mesh, color=BONE_COLOR, smooth_shading=True, specular=0.15)

    def picture(self, color_bar: tuple[str, tuple[float, float], str] | None = None) -> bytes:
        """PNG of the views, with a colour bar (map, limits, title) below."""
        import matplotlib as mpl
        from matplotlib.figure import Figure

        pixels = self._plotter.screenshot(return_img=True)
        self._plotter.close()
        figure = Figure(figsize=(14, 4.4), dpi=110)
        axes = figure.add_axes((0.0, 0.17, 1.0, 0.83))
        axes.imshow(pixels)
        axes.set_axis_off()
        if color_bar is not None:
            cmap, limits, title = color_bar
            bar = figure.add_axes((0.3, 0.13, 0.4, 0.03))
            figure.colorbar(mpl.cm.ScalarMappable(mpl.colors.Normalize(*limits), cmap), cax=bar, orientation="horizontal", label=title)
        return _png(figure)


def slices_with_points(result: CaseResult) -> bytes:
    """Axial, sagittal and coronal slices through the middle of the points, bone outline and points near the plane."""
    from matplotlib.figure import Figure

    volume, registration = result.volume, result.registration
    points = (
        registration.points_ras_mm
        if len(result.points)
        else transform_points(registration.reference_to_ras, result.landmarks_patient_mm)
    )
    middle = points.mean(axis=0)
    figure = Figure(figsize=(14, 5), dpi=110)
    for column, (name, axis) in enumerate((("axial", 2), ("coronal", 1), ("sagittal", 0))):
        axes = figure.add_subplot(1, 3, column + 1)
        across, up = [k for k in range(3) if k != axis]
        image, extent = _resampled_slice(volume.hu, volume.ijk_to_ras, middle, axis, across, up)
        axes.imshow(image, cmap="gray", vmin=-400, vmax=1600, extent=extent, origin="lower", interpolation="bilinear")
        axes.contour(np.linspace(extent[0], extent[1], image.shape[1]), np.linspace(extent[2], extent[3], image.shape[0]), image,
                     levels=[result.bone.threshold_hu], colors="#56b4e9", linewidths=0.6)  # fmt: skip
        near = np.abs(points[:, axis] - middle[axis]) < 12
        axes.scatter(points[near, across], points[near, up], s=26, c="#d55e00", edgecolors="white", linewidths=0.7)
        axes.set_title(f"{name}, {'RAS'[axis]} = {middle[axis]:.0f} mm; points within 12 mm", fontsize=9)
        axes.set_xlabel(f"{'RAS'[across]} (mm)", fontsize=8)
        axes.tick_params(labelsize=7)
        if axis != 0:
            axes.invert_xaxis()  # radiological: the patient's right is on the left
    figure.tight_layout()
    return _png(figure)


def _resampled_slice(
    hu: Any, ijk_to_ras: Array, middle: Array, axis: int, across: int, up: int
) -> tuple[Array, tuple[float, float, float, float]]:
    """An axis-aligned RAS slice at 1 mm, whatever the volume's own direction, and its extent (mm)."""
    from scipy.ndimage import map_coordinates

    corners = np.array([[i, j, k] for i in (0, hu.shape[2] - 1) for j in (0, hu.shape[1] - 1) for k in (0, hu.shape[0] - 1)])
    box = transform_points(ijk_to_ras, corners)
    low, high = box.min(axis=0), box.max(axis=0)
    a, b = np.arange(low[across], high[across], 1.0), np.arange(low[up], high[up], 1.0)
    ras = np.empty((len(b), len(a), 3))
    ras[..., axis] = middle[axis]
    ras[..., across], ras[..., up] = a[None, :], b[:, None]
    ijk = transform_points(np.linalg.inv(ijk_to_ras), ras.reshape(-1, 3))
    image = map_coordinates(hu, ijk[:, ::-1].T, order=1, cval=-1000.0, output=float).reshape(len(b), len(a))
    return image, (float(a[0]), float(a[-1]), float(b[0]), float(b[-1]))


def lines_with_echo(result: CaseResult, most: int = 18) -> bytes | None:
    """The best A-line of each palpation point (or an even choice of a sweep) with skin and bone marked."""
    from matplotlib.figure import Figure
    from ModuleUltrasoundLib.signal_chain import complex_envelopes, design_band

    if result.ultrasound is None:
        return None
    recording, measured = result.ultrasound.recording, result.ultrasound.measurements
    frames = best_frames(recording.palpation_points, measured.accepted, measured.qualities, most)
    if not frames:
        return None
    acquisition, speed = recording.acquisition, measured.speed_of_sound_m_s
    until_s = float(np.nanmax(measured.skin_times_s[frames])) + 2 * 0.025 / speed
    envelopes = complex_envelopes(recording.lines[frames], design_band(acquisition, recording.lines.shape[1], until_s))
    figure = Figure(figsize=(14, 1.55 * int(np.ceil(len(frames) / 3))), dpi=110)
    for cell, frame in enumerate(frames):
        axes = figure.add_subplot(int(np.ceil(len(frames) / 3)), 3, cell + 1)
        depth = (np.arange(envelopes.values.shape[1]) / envelopes.rate_hz - measured.skin_times_s[frame]) * speed * 1000 / 2
        level = np.abs(envelopes.values[cell])
        shown = (depth > -3) & (depth < 22)
        level_db = 20 * np.log10(np.maximum(level[shown] / level[shown].max(), 1e-4))
        axes.plot(depth[shown], level_db, color="#333333", linewidth=0.8)
        axes.set_ylim(-60, 3)
        axes.axvline(0, color="#0072b2", linewidth=1)
        axes.axvline(measured.depths_mm[frame], color="#d55e00", linewidth=1.4)
        point = int(recording.palpation_points[frame])
        name = f"point {point}" if point >= 0 else f"frame {frame}"
        axes.text(
            0.99,
            0.93,
            f"{name}: {measured.depths_mm[frame]:.2f} mm, quality {measured.qualities[frame]:.2f}",
            fontsize=7,
            transform=axes.transAxes,
            ha="right",
            va="top",
        )
        axes.set_xlim(-3, 22)
        axes.set_yticks([-60, -40, -20, 0])
        axes.tick_params(labelsize=7)
    figure.supxlabel("depth below the skin (mm) against level (dB below the highest); blue: skin, orange: bone found", fontsize=8)
    figure.tight_layout()
    return _png(figure)


def best_frames(palpation_points: Any, accepted: Any, qualities: Array, most: int) -> list[int]:
    """The best accepted frame of each palpation point, at most `most`; of a sweep an even choice."""
    good = np.flatnonzero(accepted)
    if not len(good):
        return []
    named = sorted(set(palpation_points[good].tolist()) - {-1})
    if len(named) < 2:
        return [int(frame) for frame in good[np.linspace(0, len(good) - 1, min(most, len(good))).astype(int)]]
    best = [good[palpation_points[good] == point] for point in named]
    return [int(frames[np.argmax(qualities[frames])]) for frames in best][:most]


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
