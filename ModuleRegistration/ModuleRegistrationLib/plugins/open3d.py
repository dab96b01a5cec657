"""Open3D's registration methods behind CranioNav's interface."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array, check_rigid

from ModuleRegistrationLib.registration.closest_fit import check_problem, finished_result
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration

LEAST_FOR_FEATURES = 500  # a feature histogram needs neighbours; 18 palpated points have none
LEAST_FITNESS = 0.5  # share of the sweep on the skull: three pairs make a pose, whatever they are
NORMAL_RADIUS, FEATURE_RADIUS = 3.0, 6.0  # in voxels


class Variant(Enum):
    """Which of Open3D's methods."""

    POINT_TO_PLANE = "point-to-plane"
    GENERALIZED = "generalized"
    FEATURES = "features"


class Open3dRegistration(SurfaceRegistration):
    """Works on the surface's vertices, as Open3D does; kept for comparison."""

    name = "open3d"
    title = "Open3D: point-to-plane or generalized ICP, or features and RANSAC for dense sweeps"

    @dataclass(frozen=True)
    class Settings(Parameters):
        """Open3D's own parameters."""

        variant: Annotated[Variant, "point-to-plane, generalized, or features (FPFH and RANSAC, then point-to-plane)"] = (
            Variant.POINT_TO_PLANE
        )
        max_distance_mm: Annotated[float, Limits(0.1, 1000), "farthest correspondence"] = 30.0
        max_iterations: Annotated[int, Limits(1, 10000), "steps at most"] = 100
        voxel_mm: Annotated[float, Limits(0.5, 50), "size of the cells that features are computed in"] = 5.0

    def register(self, problem: RegistrationProblem) -> RegistrationResult:
        """See the base class.

        Raises
        ------
        InputError
            `features` with fewer than 500 points, or where it finds nothing.
        """
        check_problem(problem)
        open3d: Any = importlib.import_module("open3d")
        pipeline = open3d.pipelines.registration
        source = _cloud(open3d, problem.points.positions_mm)
        target = _cloud(open3d, problem.surface.vertices_mm)
        target.normals = open3d.utility.Vector3dVector(problem.surface.vertex_normals)
        start = problem.initial_reference_to_ras
        if self.settings.variant is Variant.FEATURES:
            start = self._by_features(open3d, source, target, problem)
        criteria = pipeline.ICPConvergenceCriteria(max_iteration=self.settings.max_iterations)
        distance = self.settings.max_distance_mm
        if self.settings.variant is Variant.GENERALIZED:
            estimation = pipeline.TransformationEstimationForGeneralizedICP()
            found = pipeline.registration_generalized_icp(source, target, distance, start, estimation, criteria)
        else:
            estimation = pipeline.TransformationEstimationPointToPlane()
            found = pipeline.registration_icp(source, target, distance, start, estimation, criteria)
        if len(found.correspondence_set) < 6:
            raise InputError(f"fewer than 6 points lie within {distance:g} mm of the skull; check the landmarks")
        # Open3D does not tell how many steps it took
        reason = f"Open3D's own rule, at most {self.settings.max_iterations} iterations"
        return finished_result(
            self.name, problem, check_rigid(found.transformation, "Open3D's result"), self.settings.max_iterations, reason
        )

    def _by_features(self, open3d: Any, source: Any, target: Any, problem: RegistrationProblem) -> Array:
        if len(problem.points) < LEAST_FOR_FEATURES:
            raise InputError(
                f"variant features needs a sweep of at least {LEAST_FOR_FEATURES} points, got {len(problem.points)}; "
                "choose point-to-plane or method cranionav"
            )
        pipeline, voxel = open3d.pipelines.registration, self.settings.voxel_mm
        open3d.utility.random.seed(problem.seed)
        clouds, features = [], []
        for cloud in (source, target):
            thin = cloud.voxel_down_sample(voxel)
            search = open3d.geometry.KDTreeSearchParamHybrid(radius=NORMAL_RADIUS * voxel, max_nn=30)
            thin.estimate_normals(search)
            thin.orient_normals_towards_camera_location(thin.get_center())
            wide = open3d.geometry.KDTreeSearchParamHybrid(radius=FEATURE_RADIUS * voxel, max_nn=100)
            clouds.append(thin)
            features.append(pipeline.compute_fpfh_feature(thin, wide))
        found = pipeline.registration_ransac_based_on_feature_matching(
            clouds[0],
            clouds[1],
            features[0],
            features[1],
            True,
            1.5 * voxel,
            pipeline.TransformationEstimationPointToPoint(False),
            3,
            [
                pipeline.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                pipeline.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
            ],
            pipeline.RANSACConvergenceCriteria(100000, 0.999),
        )
        if found.fitness < LEAST_FITNESS:  # Open3D then gives back the identity, or a pose by chance
            raise InputError(
                f"variant features found no pose in which the sweep's shape is that of the skull (voxels of {voxel:g} mm); "
                "choose point-to-plane or method cranionav"
            )
        return np.asarray(found.transformation, dtype=float)


def _cloud(open3d: Any, points_mm: Array) -> Any:
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points_mm))
