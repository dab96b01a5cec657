"""Pictures of a registered case: the skull with its points, the error to expect, slices, A-lines. PNG bytes."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from CranioNavLib.rigid import Array, transform_points

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
MESH_BINS = 140  # a side of the skull: 1.3 mm, about two pixels
POINT_RADIUS_MM = 3.0
AIR_HU = -400.0  # below it there is no head
COARSE_MM = 4  # the error to expect changes slowly; between such steps it is interpolated
LANDMARK_COLOR, TARGET_COLOR = "#e69f00", "#009e73"


def skull_with_points(result: CaseResult) -> bytes:
    """Four views of the skull; bone points coloured by their signed distance to the surface, targets and landmarks."""
    import pyvista

    plotter, registration = _plotter(), result.registration
    plotter.add_mesh(_bone_mesh(result), color=BONE_COLOR, smooth_shading=True, specular=0.15)
    color_bar = None
    if len(result.points):
        cloud = pyvista.PolyData(registration.points_ras_mm)
        cloud["residual (mm)"] = registration.residuals_mm
        widest = max(float(np.ceil(2 * np.abs(registration.residuals_mm).max()) / 2), 0.5)
        balls = cloud.glyph(geom=pyvista.Sphere(radius=POINT_RADIUS_MM), scale=False, orient=False)
        plotter.add_mesh(balls, cmap=RESIDUAL_COLORS, clim=(-widest, widest), show_scalar_bar=False, ambient=0.4)
        color_bar = RESIDUAL_COLORS, (-widest, widest), "distance of a point to the bone surface (mm), + outside"
    _add_balls(plotter, transform_points(registration.reference_to_ras, result.landmarks_patient_mm), LANDMARK_COLOR)
    if result.case.targets_ct is not None:
        _add_balls(plotter, result.targets_ras_mm, TARGET_COLOR)
    return _four_views(plotter, color_bar)


def error_map(result: CaseResult) -> bytes | None:
    """Four views of the skull coloured by the 95% error to expect; None where the method gives no uncertainty."""
    from ModuleRegistrationLib.registration.error_theory import predict_tre_of

    if result.registration.covariance is None:
        return None
    mesh = _bone_mesh(result)
    p95 = predict_tre_of(result.registration, np.asarray(mesh.points)).p95_mm
    mesh["95% error (mm)"] = p95
    limits = (0.0, float(np.ceil(2 * p95.max()) / 2))
    plotter = _plotter()
    plotter.add_mesh(mesh, scalars="95% error (mm)", cmap="viridis", clim=limits, smooth_shading=True, show_scalar_bar=False)
    return _four_views(plotter, ("viridis", limits, "95% error to expect (mm)"))


def _plotter() -> Any:
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=(VIEW_PIXELS, VIEW_PIXELS))
    plotter.set_background("white")
    return plotter


def _add_balls(plotter: Any, positions: Array, color: str) -> None:
    import pyvista

    if len(positions):
        geometry = pyvista.Sphere(radius=0.8 * POINT_RADIUS_MM)
        plotter.add_mesh(pyvista.PolyData(positions).glyph(geom=geometry, scale=False, orient=False), color=color)


def _bone_mesh(result: CaseResult) -> Any:
    """The bone, thinned to what a picture shows, with smooth normals."""
    import pyvista
    from vtkmodules.vtkFiltersCore import vtkBinnedDecimation, vtkPolyDataNormals

    thin = vtkBinnedDecimation()
    thin.SetInputData(result.bone.closed.to_polydata())
    thin.SetNumberOfDivisions(MESH_BINS, MESH_BINS, MESH_BINS)
    thin.AutoAdjustNumberOfDivisionsOff()
    thin.SetPointGenerationModeToBinAverages()
    smooth = vtkPolyDataNormals()
    smooth.SetInputConnection(thin.GetOutputPort())
    smooth.SplittingOff()
    smooth.ConsistencyOff()
    smooth.Update()
    return pyvista.wrap(smooth.GetOutput())


def _four_views(plotter: Any, color_bar: tuple[str, tuple[float, float], str] | None) -> bytes:
    """PNG of the plotter's scene from four sides, with a colour bar (map, limits, title) below."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    middle, size = np.array(plotter.center), float(plotter.length)
    figure = Figure(figsize=(14, 4.4), dpi=110)
    for column, (name, (direction, up)) in enumerate(VIEWS.items()):
        camera = plotter.camera
        camera.parallel_projection = True
        camera.focal_point, camera.up = middle, up
        camera.position = middle + 2 * size * np.array(direction)
        camera.parallel_scale = 0.36 * size
        plotter.reset_camera_clipping_range()
        plotter.render()
        axes = figure.add_axes((column / len(VIEWS), 0.17, 1 / len(VIEWS), 0.76))
        axes.imshow(plotter.screenshot(return_img=True))
        axes.set_axis_off()
        axes.set_title(name, fontsize=9, color="#444444")
    plotter.close()
    if color_bar is not None:
        cmap, limits, title = color_bar
        bar = figure.add_axes((0.3, 0.13, 0.4, 0.03))
        figure.colorbar(
            mpl.cm.ScalarMappable(mpl.colors.Normalize(*limits), cmap), cax=bar, orientation="horizontal", label=title
        )
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


def error_slices(result: CaseResult) -> bytes | None:
    """Slices through the worst target, coloured inside the head by the error to expect there; None as for `error_map`."""
    from matplotlib.figure import Figure

    if result.registration.covariance is None or result.predicted is None:
        return None
    place = result.bone.outer_table.center_mm
    if result.case.targets_ct is not None:
        place = result.targets_ras_mm[int(np.argmax(result.predicted.p95_mm))]
    cuts = [_error_cut(result, place, axis) for axis in (2, 1, 0)]
    highest = max(float(np.nanmax(cut.p95_mm, initial=0.5)) for cut in cuts)
    figure = Figure(figsize=(14, 4.6), dpi=110, layout="constrained")
    plots = figure.subplots(1, len(cuts))
    for axes, cut, name in zip(plots, cuts, ("axial", "coronal", "sagittal")):
        across, up = [k for k in range(3) if k != cut.axis]
        axes.imshow(cut.hu, cmap="gray", vmin=-400, vmax=1600, extent=cut.extent, origin="lower", interpolation="bilinear")
        limits = {"vmin": 0, "vmax": np.ceil(2 * highest) / 2}
        painted = axes.imshow(cut.p95_mm, cmap="viridis", **limits, extent=cut.extent, origin="lower", alpha=0.65)
        if cut.hu.max() > result.bone.threshold_hu:
            axes.contour(cut.hu, levels=[result.bone.threshold_hu], colors="white", linewidths=0.5, extent=cut.extent)
        axes.plot(place[across], place[up], "+", color="white", markersize=14, markeredgewidth=2)
        axes.set_title(f"{name}, {'RAS'[cut.axis]} = {place[cut.axis]:.0f} mm", fontsize=9)
        axes.set_xlabel(f"{'RAS'[across]} (mm)", fontsize=8)
        axes.tick_params(labelsize=7)
        if cut.axis != 0:
            axes.invert_xaxis()  # radiological: the patient's right is on the left
    figure.colorbar(painted, ax=plots, shrink=0.8, label="95% error to expect (mm)")
    return _png(figure)


@dataclass(frozen=True, eq=False)
class _ErrorCut:
    """An axis-aligned slice and the 95% error to expect in it; NaN outside the head."""

    axis: int
    hu: Array  # (B, A)
    p95_mm: Array  # (B, A)
    extent: tuple[float, float, float, float]


def _error_cut(result: CaseResult, place: Array, axis: int) -> _ErrorCut:
    from scipy.ndimage import binary_fill_holes, label, map_coordinates

    from ModuleRegistrationLib.registration.error_theory import predict_tre_of

    across, up = [k for k in range(3) if k != axis]
    hu, extent = _resampled_slice(result.volume.hu, result.volume.ijk_to_ras, place, axis, across, up)
    parts, _ = label(hu > AIR_HU)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    inside = binary_fill_holes((parts == np.argmax(sizes)) & (parts > 0))  # the head, not the table under it
    rows, columns = (np.arange(0, size + COARSE_MM, COARSE_MM) for size in hu.shape)  # a slice has 1 mm pixels
    ras = np.empty((len(rows), len(columns), 3))
    ras[..., axis] = place[axis]
    ras[..., across], ras[..., up] = extent[0] + columns[None, :], extent[2] + rows[:, None]
    coarse = predict_tre_of(result.registration, ras.reshape(-1, 3)).p95_mm.reshape(ras.shape[:2])
    p95 = map_coordinates(coarse, np.indices(hu.shape) / COARSE_MM, order=1)
    p95[~inside] = np.nan
    return _ErrorCut(axis, hu, p95, extent)


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
    from ModuleUltrasoundLib.echo.signal_chain import complex_envelopes, design_band

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
