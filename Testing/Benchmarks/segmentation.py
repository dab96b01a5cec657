"""How long and how much memory it takes from a CT of 512 x 512 x 110 voxels to its outer bone surface.

    python Testing/Benchmarks/segmentation.py [--ct PATH] [--repeat N]

Without `--ct` the sample head is resampled to 512 x 512 x 110. Beside our methods stand the plain ways to a whole
bone surface: SimpleITK label and vtkDiscreteFlyingEdges3D, and vtkFlyingEdges3D on the HU values. Times are the
shortest of the repeats, wall clock and processor; memory is the peak of a process of its own, libraries included.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from CranioNavLib.volume import Volume


def the_volume(ct: str | None) -> Volume:
    """The CT to work on."""
    if ct is not None:
        from ModuleRegistrationLib.anatomy.ct_reader import read_ct

        return read_ct(ct)
    from CranioNavLib.sample_head import load_sample_head
    from scipy.ndimage import zoom

    head = load_sample_head()
    shape = np.array((110, 512, 512))
    hu = zoom(head.hu, shape / head.hu.shape, order=1, grid_mode=True, mode="nearest")
    matrix = head.ijk_to_ras.copy()
    matrix[:3, :3] *= (np.array(head.hu.shape) / shape)[::-1]
    return Volume(hu, matrix)


def threshold(volume: Volume) -> int:
    """Our default method, outer table and closed surface."""
    from ModuleRegistrationLib.plugins.threshold import ThresholdSegmentation

    return len(ThresholdSegmentation().segment(volume).outer_table.triangles)


def gradient(volume: Volume) -> int:
    """Our edge-corrected method."""
    from ModuleRegistrationLib.plugins.gradient import GradientSegmentation

    return len(GradientSegmentation().segment(volume).outer_table.triangles)


def label_and_discrete_edges(volume: Volume) -> int:
    """SimpleITK threshold and largest component, surface of the label: whole bone, stepped."""
    import SimpleITK as sitk
    from vtkmodules.vtkFiltersGeneral import vtkDiscreteFlyingEdges3D

    bone = sitk.GetImageFromArray(volume.hu) >= 300
    label = sitk.RelabelComponent(sitk.ConnectedComponent(bone), sortByObjectSize=True) == 1
    return _contour(vtkDiscreteFlyingEdges3D(), sitk.GetArrayFromImage(label), 1)


def edges_on_hu(volume: Volume) -> int:
    """vtkFlyingEdges3D on the HU values: whole bone and holder."""
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    return _contour(vtkFlyingEdges3D(), volume.hu, 300)


def _contour(contour: object, array: np.ndarray, value: float) -> int:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData

    image = vtkImageData()
    image.SetDimensions(*array.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(array.ravel()))
    contour.SetInputData(image)  # type: ignore[attr-defined]
    contour.SetValue(0, value)  # type: ignore[attr-defined]
    contour.Update()  # type: ignore[attr-defined]
    return int(contour.GetOutput().GetNumberOfPolys())  # type: ignore[attr-defined]


METHODS: dict[str, Callable[[Volume], int]] = {
    "threshold": threshold,
    "gradient": gradient,
    "SimpleITK label + vtkDiscreteFlyingEdges3D": label_and_discrete_edges,
    "vtkFlyingEdges3D on HU": edges_on_hu,
}


def measure(name: str, path: Path, repeat: int, results: multiprocessing.Queue) -> None:
    """Run one method in this process and report."""
    with np.load(path) as file:
        volume = Volume(file["hu"], file["ijk_to_ras"])
    wall, processor, triangles = [], [], 0
    for _ in range(repeat):
        start, used = time.perf_counter(), time.process_time()
        triangles = METHODS[name](volume)
        wall.append(time.perf_counter() - start)
        processor.append(time.process_time() - used)
    results.put((wall[0], min(wall), min(processor), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, triangles))


def main() -> None:
    """Print the table."""
    import tempfile

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--ct", help="a CT instead of the sample head")
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    volume = the_volume(options.ct)
    context = multiprocessing.get_context("spawn")
    print(f"{' x '.join(str(n) for n in volume.hu.shape[::-1])} voxels")
    print(f"{'':44}{'first s':>9}{'best s':>9}{'cpu s':>9}{'peak MB':>9}{'triangles':>11}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ct.npz"
        np.savez(path, hu=volume.hu, ijk_to_ras=volume.ijk_to_ras)
        for name in METHODS:
            results: multiprocessing.Queue = context.Queue()
            process = context.Process(target=measure, args=(name, path, options.repeat, results))
            process.start()
            first, best, processor, peak, triangles = results.get()
            process.join()
            print(f"{name:44}{first:9.2f}{best:9.2f}{processor:9.2f}{peak:9.0f}{triangles:11d}")


if __name__ == "__main__":
    main()
