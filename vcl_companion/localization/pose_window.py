"""The poses of a drone's last views, and what these err by together (stochastic cloning).

A view's pose is off by what the keyframes are off that it was found by, as its fix tells (the
lever), and by what is its own. Found by the swarm's map, views share that map's error; found by a
local map, the errors of the earlier views that this was made of. Kept together this says how well
views are known *to each other*: what a local map gets its scale from, and passes on with it
(Roumeliotis & Burdick, Stochastic Cloning, 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from vcl_companion.geometry.pose import Pose, adjoint
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.fix import Localized
from vcl_companion.mapping.view_adjustment import Placement

_View = TypeVar("_View")


class PoseWindow(Generic[_View]):
    """Views in the order of their time, with their poses and these poses' joint covariance.

    Attributes:
        views: what they are called, the oldest first.
        poses: world_from_body of each.
    """

    def __init__(self) -> None:
        self.views: list[_View] = []
        self.poses: list[Pose] = []
        self._are_by_map: list[bool] = []
        # Of the views' poses, and of the keyframes of the swarm's map after them.
        self._covariance = np.zeros((0, 0))
        self._map_covariance: Array | None = None

    def clear(self) -> None:
        """Forget all views."""
        self.views.clear()
        self.poses.clear()
        self._are_by_map.clear()
        self._covariance, self._map_covariance = np.zeros((0, 0)), None

    def pose_of(self, view: _View) -> Pose:
        """Return where a view was taken.

        Raises:
            ValueError: it is not in the window.
        """
        return self.poses[self.views.index(view)]

    def covariance_of(self, views: Sequence[_View]) -> Array:
        """Return (6K, 6K) of the poses of some views together, local, m and rad.

        Raises:
            ValueError: one is not in the window.
        """
        rows = self._rows_of(views)
        return np.asarray(self._covariance[np.ix_(rows, rows)])

    def add_by_map(self, view: _View, fix: Localized) -> None:
        """Add a view that was found by the swarm's map.

        How it errs with views that were found by an earlier one nobody knows: as if it did not.
        """
        n = 6 * len(self.views)
        if fix.keyframe_covariance is not self._map_covariance:
            self._map_covariance = fix.keyframe_covariance
            self._covariance = block_diag(self._covariance[:n, :n], fix.keyframe_covariance)
        lever = np.zeros((6, len(self._covariance)))
        lever[:, n:] = fix.map_lever
        self._add(view, fix, lever, is_by_map=True)

    def add_by_views(self, view: _View, fix: Localized, keyframes: Sequence[_View]) -> None:
        """Add a view that was found by a map of earlier ones.

        Args:
            view: the view.
            fix: how it was found.
            keyframes: of that map, all in the window.

        Raises:
            ValueError: one is not.
        """
        lever, n = np.zeros((6, len(self._covariance))), 6 * len(keyframes)
        lever[:, self._rows_of(keyframes)] = fix.map_lever[:, :n]
        by_scene = fix.map_lever[:, n:]
        self._add(view, fix, lever, is_by_map=False)
        rows = self._rows_of([view])
        scene = fix.keyframe_covariance[n:, n:]
        self._covariance[np.ix_(rows, rows)] += by_scene @ scene @ by_scene.T

    def settle(self, views: Sequence[_View], placement: Placement) -> None:
        """Keep some views alone, which have been placed anew together.

        Args:
            views: they, all in the window.
            placement: where they are, in their order.

        Raises:
            ValueError: one is not in the window.
        """
        n = 6 * len(self.views)
        with_map = placement.by_before @ self._covariance[self._rows_of(views), n:]
        joint = np.block([[placement.covariance, with_map], [with_map.T, self._covariance[n:, n:]]])
        order = sorted(range(len(views)), key=lambda k: self.views.index(views[k]))
        of_views = (6 * np.array(order)[:, None] + np.arange(6)).ravel()
        rows = np.concatenate([of_views, np.arange(6 * len(views), len(joint))])
        self._covariance = joint[np.ix_(rows, rows)]
        self._are_by_map = [self._are_by_map[self.views.index(views[k])] for k in order]
        self.views = [views[k] for k in order]
        self.poses = [placement.bodies[k] for k in order]

    def displace(self, by: Pose, at: Pose, covariance: Array) -> None:
        """Move all views together: what the earlier ones had led the last one to was off.

        Where the swarm's map has put the last one, all stay: it is the way from there that was not
        as believed.

        Args:
            by: what their poses are moved by, in the world.
            at: where we are in truth.
            covariance: (6, 6) local, of that: what all are off by from now on, whatever they were.
        """
        n = 6 * len(self.views)
        if n == 0 or self._are_by_map[-1]:
            return
        self.poses = [by @ pose for pose in self.poses]
        lever = np.concatenate([adjoint(pose.inverse() @ at) for pose in self.poses])
        self._covariance[:n, :n] += lever @ covariance @ lever.T

    def drop(self, index: int) -> None:
        """Drop a view."""
        rows = np.arange(6 * index, 6 * index + 6)
        self._covariance = np.delete(np.delete(self._covariance, rows, axis=0), rows, axis=1)
        del self.views[index], self.poses[index], self._are_by_map[index]

    def _rows_of(self, views: Sequence[_View]) -> NDArray[np.intp]:
        first = np.array([6 * self.views.index(view) for view in views], dtype=np.intp)
        return np.asarray((first[:, None] + np.arange(6)).ravel())

    def _add(self, view: _View, fix: Localized, lever: Array, *, is_by_map: bool) -> None:
        """Add a view that errs as all before do by a lever, and by itself."""
        n = 6 * len(self.views)
        grown = np.eye(len(self._covariance))
        grown = np.vstack([grown[:n], lever, grown[n:]])
        joint = grown @ self._covariance @ grown.T
        joint[n : n + 6, n : n + 6] += fix.noise_covariance + fix.own_map_covariance
        self._covariance = 0.5 * (joint + joint.T)
        self.views.append(view)
        self.poses.append(fix.world_from_body)
        self._are_by_map.append(is_by_map)
