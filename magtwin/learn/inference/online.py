"""OnlineMagnetometer: a mixed model that follows its session, wherever poses become known."""

import math
from collections.abc import Sequence

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap, Outside
from magtwin.learn.inference.calibrate import (
    check_pose_sd,
    known_columns,
    labelled_drive,
    mixed_of_kind,
)
from magtwin.learn.inference.magnetometer import Read
from magtwin.learn.inference.reader import Reader, Reading, Signals
from magtwin.learn.mixed.followed import DELAY_S, MEMORY_S, FollowedEffects, followed
from magtwin.learn.mixed.mixed import Mixed
from magtwin.learn.models.predictor import Predictor
from magtwin.run.run import Run


class OnlineMagnetometer:
    """Reads a mixed model pose by pose and follows the effects of the session. Not thread-safe.

    A live robot calls `read` for each reading, and `update` with an earlier reading as soon as its pose is
    known, some seconds later. Both take some 0.1 ms. Poses that were estimated on the same map make the
    result circular.

        online = OnlineMagnetometer(model, field)
        online.update(t, p_xy, yaw, signals, b_measured_nt)  # 10 s ago
        reading = online.read(t, p_xy, yaw, signals)         # now
    """

    def __init__(
        self,
        model: Predictor,
        field: AnomalyMap,
        *,
        lever_arm_m: tuple[float, float] = (0.0, 0.0),
        delay_s: float = DELAY_S,
        memory_s: float = MEMORY_S,
        pose_sd_m: float = 0.0,
    ) -> None:
        """Begin with the effects of a model, the prior or those of its drive.

        Args:
            model: A mixed model.
            field: The map that it was trained on.
            lever_arm_m: As for `magtwin.learn.inference.reader.Reader`.
            delay_s: Typical age of a pose when it becomes known [s].
            memory_s: Time over which effects return to their prior mean [s].
            pose_sd_m: Standard deviation of positions, each axis [m].

        Raises:
            InputError: The model is of another kind, or a time is not above 0.
        """
        self.model = _checked(model, delay_s, memory_s, pose_sd_m)
        self.pose_sd_m = pose_sd_m
        self.effects = FollowedEffects(
            self.model.prior,
            start=self.model.session,
            delay_s=delay_s,
            memory_s=memory_s,
            ways=self.model.ways,
        )
        self._reader = Reader(self.model, field, lever_arm_m=lever_arm_m)

    @property
    def signals(self) -> tuple[str, ...]:
        """Columns of a Run that `read` and `update` need from the robot."""
        return self._reader.signals

    def update(
        self,
        t: float,
        p_xy: Sequence[float],
        yaw: float,
        signals: Signals,
        b_measured_nt: float,
        *,
        pose_sd_m: float | None = None,
    ) -> bool:
        """Use an earlier reading whose pose has become known.

        Args:
            t: Its time [s], after that of the last update.
            p_xy: Position of base_link in world then [m].
            yaw: Heading then [rad].
            signals: Values of `signals` then.
            b_measured_nt: The field that was measured [nT].
            pose_sd_m: Standard deviation of this position, each axis [m]. Default: that of all.

        Returns:
            Whether it was used. At most 4 readings a second are; not those off the map or with nan.

        Raises:
            InputError: A signal is missing or has the wrong number of parts.
        """
        row = self._reader.row(p_xy, yaw, signals)
        phi = self.model.regressors(row.x[None])
        noise = float(self.model.noise_nt2(phi)[0])
        sd_m = self.pose_sd_m if pose_sd_m is None else pose_sd_m
        if sd_m:
            slope = self._reader.field.at_with_gradient(*row.p_xy, yaw)[1:3]
            noise += (slope[0] ** 2 + slope[1] ** 2) * sd_m**2
        return self.effects.update(t, phi[0], b_measured_nt - row.b_map_nt, noise)

    def read(
        self, t: float, p_xy: Sequence[float], yaw: float, signals: Signals, *, outside: Outside = "nan"
    ) -> Reading:
        """One reading with the effects of now; the arguments are those of `update` and `Reader.row`."""
        row = self._reader.row(p_xy, yaw, signals, outside=outside)
        phi = self.model.regressors(row.x[None])
        mean, variance = self.effects.predict(np.array([t]), phi)
        factor = self.model.factors["online"] * self.effects.widening
        sd = factor * math.sqrt(float(self.model.noise_nt2(phi)[0]) + float(variance[0]))
        beyond = bool(self.model.outside(row.x[None])[0])
        return Reading(row.b_map_nt + float(mean[0]), row.b_map_nt, float(mean[0]), sd, beyond)


def read_online(
    model: Predictor,
    run: Run,
    field: AnomalyMap,
    *,
    delay_s: float = DELAY_S,
    memory_s: float = MEMORY_S,
    pose_sd_m: float = 0.0,
) -> Read:
    """Predictions for the rows of a run, each from the readings at least `delay_s` before it.

    Args:
        model: A mixed model.
        run: A run with poses and measured field.
        field: The map that the model was trained on.
        delay_s: Age of a pose when it becomes known [s].
        memory_s: As for `OnlineMagnetometer`.
        pose_sd_m: Standard deviation of positions, each axis [m].

    Raises:
        InputError: As for `magtwin.calibrate`.
    """
    model = _checked(model, delay_s, memory_s, pose_sd_m).reading(known_columns(run))
    drive = labelled_drive(model, run, field, rate_hz=None)
    phi = model.regressors(drive.x)
    noise = model.noise_nt2(phi)
    effects = FollowedEffects(
        model.prior, start=model.session, delay_s=delay_s, memory_s=memory_s, ways=model.ways
    )
    mean, sd = followed(
        effects, phi, drive.y, noise + drive.pose_variance_nt2(pose_sd_m), drive.t, predicted_nt2=noise
    )
    return Read(mean, model.factors["online"] * sd, model.outside(drive.x))


def _checked(model: Predictor, delay_s: float, memory_s: float, pose_sd_m: float) -> Mixed:
    if not 0 <= delay_s < math.inf:
        raise InputError(f"delay_s must be 0 or more and finite, got {delay_s!r}")
    check_pose_sd(pose_sd_m)
    if not memory_s > 0:
        raise InputError(f"memory_s must be above 0, got {memory_s!r}")
    return mixed_of_kind(model)
