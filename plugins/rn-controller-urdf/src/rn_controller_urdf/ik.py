"""Inverse kinematics by damped least squares, kept inside the joint limits at every iteration."""

from __future__ import annotations

import math
from operator import le
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rn_controller_urdf.model import ArmModel

if TYPE_CHECKING:
    from types import ModuleType

    import pinocchio

F64 = NDArray[np.float64]

_DAMPING = 1e-8
"""Smallest squared damping: far below the squared singular values of a usable posture (about 0.1
each).
"""
_DAMPING_BY_ERROR = 1e-2
"""Squared damping per squared error: careful steps far from the target, undamped ones close to it.
Source: Sugihara 2011, eq. 22.
"""
_FARTHEST_STEP = 0.5
"""Longest change of one joint in one iteration [rad or m]: beyond it the linearisation is
invalid.
"""


class Solution(NamedTuple):
    """Result of the solver, converged or not.

    Attributes:
        position: float64 (n,), within the limits [rad or m].
        residual_m, residual_rad: remaining distance and angle to the target.
        iterations: number of steps.
    """

    position: F64
    residual_m: float
    residual_rad: float
    iterations: int


class InverseKinematics:
    """Solver of one arm; its scratch memory allows one thread per instance.

    Poses are `pinocchio.SE3`, TCP in the base frame.
    """

    def __init__(self, model: ArmModel) -> None:
        import eigenpy  # type: ignore[import-untyped]  # heavy; comes with pinocchio
        import pinocchio  # heavy

        self._pin: ModuleType = pinocchio
        self._model = model
        self._data = model.kinematics.createData()
        # the matrix of the normal equations, its diagonal and factorization, by rows: cached,
        # because an iteration spends more time on creating arrays than on their numbers
        self._scratch = {}
        for rows in (3, 6):
            normal = np.empty((rows, rows))
            self._scratch[rows] = normal, normal.reshape(-1)[:: rows + 1], eigenpy.LLT(rows)
        self._bounds = model.lower.tolist(), model.upper.tolist()
        self._local = pinocchio.ReferenceFrame.LOCAL

    def place(self, position: F64) -> pinocchio.SE3:
        """Forward kinematics: arm positions (n,) -> TCP pose."""
        model = self._model
        self._pin.forwardKinematics(model.kinematics, self._data, self._chain_positions(position))
        return self._pin.updateFramePlacement(model.kinematics, self._data, model.tcp_frame).copy()

    def quaternion(self, pose: pinocchio.SE3) -> F64:
        """Unit quaternion (4,) x y z w with w >= 0 of a pose."""
        values: F64 = np.array(self._pin.Quaternion(pose.rotation).coeffs())
        return values if values[3] >= 0.0 else -values

    def smallest_singular_value(self, position: F64, *, track_rotation: bool = True) -> float:
        """Distance of a posture (n,) from a singularity: smallest singular value of the TCP's
        Jacobian, in m and rad per joint unit.
        """
        model, pin = self._model, self._pin
        pin.computeJointJacobians(model.kinematics, self._data, self._chain_positions(position))
        pin.updateFramePlacement(model.kinematics, self._data, model.tcp_frame)
        jacobian: F64 = pin.getFrameJacobian(
            model.kinematics, self._data, model.tcp_frame, self._local
        )
        rows = self._rows(jacobian, track_rotation)
        return float(np.linalg.svd(rows, compute_uv=False)[-1])

    def shift(self, pose: pinocchio.SE3, translation_m: F64, rotation_rad: F64) -> pinocchio.SE3:
        """Pose after a delta in the base frame: p' = p + d, R' = exp(r) R, like
        `roboneuron.contract.apply_delta`.
        """
        return self._pin.SE3(
            np.dot(self._pin.exp3(rotation_rad), pose.rotation), pose.translation + translation_m
        )

    def solve(
        self,
        start: F64,
        target: pinocchio.SE3,
        *,
        tolerance_m: float,
        tolerance_rad: float,
        max_iterations: int,
        track_rotation: bool = True,
    ) -> Solution:
        """Return a posture near `start` that reaches `target`, or the best intermediate one.

        Args:
            start: float64 (n,), within the limits.
            target: pose of the TCP in the base frame.
            tolerance_m, tolerance_rad: tolerances at which the iteration stops.
            max_iterations: maximum number of iterations.
            track_rotation: False solves for the position alone.

        Source: Nakamura and Hanafusa 1986 (damped least squares); joints at a limit are frozen and
        the step is repeated with the others.
        """
        # As long as no score is a number, the caller sees infinite residuals and refuses.
        data, kinematics, frame = self._data, self._model.kinematics, self._model.tcp_frame
        # local variables: an iteration takes a few microseconds
        measure, update = self._pin.computeJointJacobians, self._pin.updateFramePlacement
        log6, hypot = self._pin.log6, math.hypot
        q, lowest = start, math.inf
        best, best_m, best_rad, steps = start, math.inf, math.inf, 0
        for iteration in range(max_iterations + 1):
            measure(kinematics, data, self._chain_positions(q))
            # in axes of the TCP frame
            difference = update(kinematics, data, frame).actInv(target)
            error: F64 = log6(difference).vector
            residual_m = hypot(*difference.translation.tolist())
            residual_rad = hypot(*error.tolist()[3:])
            score = residual_m + residual_rad if track_rotation else residual_m
            if score < lowest:
                lowest = score
                best, best_m, best_rad, steps = q, residual_m, residual_rad, iteration
                if residual_m <= tolerance_m and (
                    residual_rad <= tolerance_rad or not track_rotation
                ):
                    break
            if iteration < max_iterations:
                if not track_rotation:
                    error = difference.translation
                q = self._step(q, error, self._jacobian(track_rotation))
        return Solution(position=best, residual_m=best_m, residual_rad=best_rad, iterations=steps)

    def _chain_positions(self, position: F64) -> F64:
        if self._model.coupling is None:
            return position
        gain, offset = self._model.coupling
        chain: F64 = gain @ position + offset
        return chain

    def _jacobian(self, track_rotation: bool) -> F64:
        """Jacobian (k, n) in axes of the TCP frame, of the posture evaluated last."""
        model = self._model
        jacobian: F64 = self._pin.getFrameJacobian(
            model.kinematics, self._data, model.tcp_frame, self._local
        )
        return self._rows(jacobian, track_rotation)

    def _rows(self, jacobian: F64, track_rotation: bool) -> F64:
        """Rows (k, n) of the arm joints of a Jacobian of the chain's."""
        if jacobian.ndim == 1:  # of one joint
            jacobian = jacobian[:, np.newaxis]
        if self._model.coupling is not None:
            jacobian = jacobian @ self._model.coupling[0]
        return jacobian if track_rotation else jacobian[:3]

    def _step(self, q: F64, error: F64, jacobian: F64) -> F64:
        rows = len(error)
        squared = _DAMPING + _DAMPING_BY_ERROR * float(error.dot(error))
        normal, diagonal, cholesky = self._scratch[rows]
        while True:
            jacobian.dot(jacobian.T, out=normal)
            diagonal += squared
            cholesky.compute(normal)
            change = cholesky.solve(error).dot(jacobian)
            farthest = max(map(abs, change.tolist()))
            if farthest > _FARTHEST_STEP:
                change *= _FARTHEST_STEP / farthest
            wanted: F64 = q + change
            if self._is_within(wanted.tolist()):
                return wanted
            reached: F64 = np.minimum(np.maximum(wanted, self._model.lower), self._model.upper)
            stuck = (reached == q) & (wanted != q)
            if not stuck.any():
                return reached
            jacobian = np.where(stuck, 0.0, jacobian)

    def _is_within(self, position: list[float]) -> bool:
        """True if all are numbers within the limits; for so few values, comparing lists is
        faster.
        """
        lower, upper = self._bounds
        return all(map(le, lower, position)) and all(map(le, position, upper))
