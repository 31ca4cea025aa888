"""What this drone believes of its pose: fixes of its own and peers' proposals, each at its time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from vcl_companion.daemon.jump_witness import RECENTLY_NS, JumpWitness
from vcl_companion.daemon.last_own_fix import FRESH_NS, LastOwnFix
from vcl_companion.daemon.local_frame import LocalFrame
from vcl_companion.daemon.map_in_sight import MapInSight
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import (
    Array,
    exp_so3,
    heading_of,
    log_so3,
    quaternion_from_matrix,
)
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.links.autopilot_options import Heading
from vcl_companion.localization.filter_state import FilterState, carried, north_aligned
from vcl_companion.localization.fix import Localized, NotLocalized, disagreement
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pose_filter import FilterOptions, predict, started, update
from vcl_companion.localization.pose_history import PoseHistory
from vcl_companion.localization.proposals import NotFused, started_from_proposal

# So many fixes in a row that contradict the state are right, and the state is wrong.
_MAX_CONTRADICTED = 5
# How far back a proposal may reach; a peer that takes longer speaks of another place.
HISTORY_S = 5.0
# How far back frames may still be found that were lost beyond what the map showed then.
LOST_S = 12.0
# A frame that has come may be being looked at right now.
_SETTLE_S = 0.5
# How we turn is told by so long; it does not go on for ever.
_TURNED_NS, _FURTHEST_RAD = 330_000_000, np.deg2rad(60.0)
_LEAST_ARM_M = 1.0
# Of what a heading may be off, this share is left to each of the two that are compared.
_DRAWN_ASIDE = 0.5


class Estimator:
    """The pose filter with its recent past; everything happens in the event loop's thread.

    Args:
        options: of the filter.
        localization: how far a pose may disagree with the autopilot's attitude.
        jumped: told of a jump, and of what made it.
        keeps_local: whether the autopilot goes on being told poses in the frame that it knows
            when our map's world is left; else it is told the other world's, a jump.
        heading: whose north that frame has (``LocalFrame``).
        has_heading: whether the autopilot's heading is its own, so by the map's north but for a
            few degrees; else only how it changes counts.
    """

    def __init__(
        self,
        options: FilterOptions,
        localization: LocalizationOptions,
        jumped: Callable[[str], None],
        *,
        keeps_local: bool = True,
        heading: Heading = "map",
        has_heading: Callable[[], bool] = lambda: True,
    ) -> None:
        self._has_heading = has_heading
        self._keeps_local = keeps_local
        self._options = options
        self._localization = localization
        self._jumped = jumped
        self._history = PoseHistory(HISTORY_S, options, LOST_S)
        self._n_contradicted = 0
        self._witness = JumpWitness(options)
        self._has_begun = False
        self.n_resets = 0
        """How often the pose has jumped."""
        self.n_forgotten = 0
        """How often all was forgotten: what was looked at before is led by what counts no more."""
        self.n_displaced = 0
        """How often it has to where our own frames had not led: these are no help there."""
        self.local = LocalFrame(heading)
        """The frame that the autopilot is told poses in."""
        self.in_sight = MapInSight()
        """What the frames show of the map."""
        self.last_own_fix = LastOwnFix(options.speed_m_s)
        """What proposals are held against."""

    @property
    def has_heading(self) -> bool:
        """Whether the autopilot's heading is by the map's north but for a few degrees.

        One that our fixes have shown to be off by more, as a compass beside steel is, says no more
        than how it changes: it would refuse every fix that is right.
        """
        state = self._history.newest
        if state is not None and state.ned_from_body is not None:
            off_deg = abs(math.degrees(heading_of(state.world_from_ned)))
            if off_deg > _DRAWN_ASIDE * self._localization.max_heading_deg:
                return False
        return self._has_heading()

    def for_peers(self, at_ns: int, ned_from_body: Array | None) -> tuple[Array | None, bool]:
        """Return an attitude as peers are told it: by the map's north, as far as we know that.

        Args:
            at_ns: its instant.
            ned_from_body: (3, 3) as the autopilot says, or None.

        Returns:
            (4,) unit quaternion or None, and whether its heading tells peers anything.
        """
        if ned_from_body is None:
            return None, True
        state = self._history.at(at_ns) or self._history.newest
        if state is None or state.ned_from_body is None:
            return quaternion_from_matrix(ned_from_body), self.has_heading
        return quaternion_from_matrix(north_aligned(state) @ ned_from_body), True

    def is_localized(self, now_ns: int) -> bool:
        """Whether a frame of the last two seconds gave a pose, by a fix or by a proposal."""
        state = self._history.newest
        return state is not None and now_ns - state.fixed_at_ns <= FRESH_NS

    async def settled(self, at_ns: int, now_ns: int) -> None:
        """Wait a moment until the frame of an instant has been looked at; not while we are lost."""
        if self.is_localized(now_ns):
            await self.in_sight.looked_at(at_ns, _SETTLE_S)

    @property
    def sigma_m(self) -> float:
        """Our newest position's 1 sigma in its worst direction, m; infinite without a state."""
        state = self._history.newest
        if state is None:
            return math.inf
        return worst_sigma(state.pose_covariance()[:3, :3])

    def course(self, ahead_s: float) -> Pose | None:
        """Return where we shall be in so many seconds, flying on and looking as now.

        None without a state.
        """
        state = self._history.newest
        if state is None:
            return None
        pose = state.world_from_body
        return Pose(pose.rotation, pose.translation + ahead_s * state.velocity_world)

    def turning_course(self, ahead_s: float) -> Pose | None:
        """Return where we shall be in so many seconds, flying and turning on as now.

        By how we turned over the last third of a second; None without a state of then.
        """
        there, newest = self.course(ahead_s), self._history.newest
        if there is None or newest is None:
            return None
        before = self._history.before(newest.at_ns - _TURNED_NS)
        if before is None:
            return None
        turned = log_so3(before.world_from_body.rotation.T @ there.rotation)
        ahead = turned * (1e9 * ahead_s / (newest.at_ns - before.at_ns))
        furthest = min(1.0, _FURTHEST_RAD / max(float(np.linalg.norm(ahead)), 1e-9))
        return Pose(there.rotation @ exp_so3(furthest * ahead), there.translation)

    def keep_of(self, has_frame: Callable[[int], bool]) -> None:
        """Keep what is believed of frames since the last fix while they are there themselves."""
        self._history.has_frame = has_frame

    def forget(self) -> None:
        """Know nothing of where we are any more: the next frame is looked for everywhere."""
        self.n_forgotten += 1
        self._history.clear()
        self._n_contradicted = 0
        self._witness.forget()
        self.last_own_fix.forget()
        self.in_sight.forget_shown()

    def own_fix_at(self, at_ns: int) -> FilterState | None:
        """Return what was believed at a frame that had a fix on the map; None at any other."""
        return self._history.own_fix_at(at_ns)

    def fix_at(self, at_ns: int) -> Localized | None:
        """Return what a frame gave on the map; None when that was nothing."""
        return self._history.fix_at(at_ns)

    def predicted(self, at_ns: int, ned_from_body: Array | None) -> FilterState | None:
        """Return the state carried to a frame's instant; None when there is none, or too old.

        For a frame older than the newest one it is what is believed of that instant.
        """
        if self._is_late(at_ns):
            return self._history.at(at_ns)
        newest = self._history.newest
        state = None if newest is None else predict(newest, at_ns, ned_from_body, self._options)
        if state is None:
            self._history.clear()
        return state

    def take_nothing(
        self, predicted: FilterState | None, at_ns: int, ned_from_body: Array | None
    ) -> None:
        """Note a frame without a fix: one may still come for its instant, or a proposal."""
        if self._is_late(at_ns):
            return
        if predicted is not None:
            self._history.append(predicted, None, ned_from_body)
        self.in_sight.note(at_ns, None)

    def coasted_at(self, at_ns: int) -> FilterState | None:
        """Return where attitude and motion alone put a frame that gave no fix.

        None when that tells too little: the last fix is too long ago, the position
        too vague, without an attitude, or while the frames contradict the state.
        """
        state = self._history.at(at_ns)
        if state is None or state.ned_from_body is None or self._n_contradicted:
            return None
        if not 0 < at_ns - state.fixed_at_ns <= self._options.coast_s * 1e9:
            return None
        return state if self._is_certain(state) else None

    def propagated(
        self, at_ns: int, ned_from_body: Array | None, within_s: float
    ) -> FilterState | None:
        """Return where attitude and motion put us at an instant that no frame is of.

        Args:
            at_ns: the instant.
            ned_from_body: (3, 3) attitude of it, or None.
            within_s: how long after a fix.

        Returns:
            The state; None when that tells too little: the fix is too long ago, or a frame since
            gave none and ``coast_s`` is over, the position too vague, without an attitude, or
            while the frames contradict the state.
        """
        state = self._history.before(at_ns)
        if state is None or ned_from_body is None or self._n_contradicted:
            return None
        if state.at_ns > state.fixed_at_ns:
            within_s = self._options.coast_s
        if at_ns - state.fixed_at_ns > max(within_s, self._options.coast_s) * 1e9:
            return None
        there = predict(state, at_ns, ned_from_body, self._options)
        return there if there is not None and self._is_certain(there) else None

    def carried_on(
        self, state: FilterState, at_ns: int, ned_from_body: Array | None
    ) -> FilterState | None:
        """Return where a state that was believed once put us at a later instant."""
        return predict(state, at_ns, ned_from_body, self._options)

    def _is_certain(self, state: FilterState) -> bool:
        """Whether a state's position is known as well as a frame has to tell it."""
        sigma_m = worst_sigma(state.pose_covariance()[:3, :3])
        return sigma_m <= self._localization.max_sigma_m

    def take_fix(
        self,
        predicted: FilterState | None,
        fix: Localized,
        at_ns: int,
        ned_from_body: Array | None,
    ) -> FilterState | NotLocalized:
        """Bring the state up to a frame's fix.

        One that comes late is taken in at its own time, and what has been measured since
        is applied again.

        Returns:
            The state after the frame, or why the fix is not believed; the frame
            then counts as one without.
        """
        if self._is_late(at_ns):
            return self._take_late(fix, at_ns)
        state = started(fix, at_ns, ned_from_body, self._options)
        if predicted is not None:
            updated = update(predicted, fix)
            if isinstance(updated, FilterState):
                if updated.n_jumps > predicted.n_jumps:
                    witnessed = self._witness.heard(
                        predicted, updated, fix, ned_from_body, self._recent(at_ns)
                    )
                    if isinstance(witnessed, NotLocalized):
                        self.take_nothing(predicted, at_ns, ned_from_body)
                        return witnessed
                    self._relocalized(fix)
                    updated = witnessed
                state = updated
            elif not self._begins_anew(fix):
                self.take_nothing(predicted, at_ns, ned_from_body)
                return updated
            else:
                self._history.clear()
        elif self._has_begun:
            self._relocalized(fix)
        self._n_contradicted = 0
        self._has_begun = True
        self._witness.forget()
        self._history.append(state, fix, ned_from_body)
        self.last_own_fix.note(state)
        self.in_sight.note(at_ns, fix if fix.is_on_map else None)
        return state

    def _take_late(self, fix: Localized, at_ns: int) -> FilterState | NotLocalized:
        before = self._history.at(at_ns)
        unwitnessed = before and self._witness.heard_late(before, fix, self._recent(at_ns))
        if unwitnessed:
            return unwitnessed
        state = self._history.refit(at_ns, fix)
        if before is None or state is None:
            return NotLocalized("found after a later frame had been")
        if isinstance(state, NotLocalized):
            # Where every frame has to be searched for, all are found late.
            if not self._begins_anew(fix):
                return state
            state = started(fix, at_ns, before.ned_from_body, self._options)
            # Where our own frames lead on from there, they do.
            if not self._history.restart(state, fix):
                self._history.clear()
                self._history.append(state, fix, before.ned_from_body)
        elif state.n_jumps > before.n_jumps:
            self._relocalized(fix)
        self._n_contradicted = 0
        self._has_begun = True
        self.in_sight.note_shown(at_ns, fix)
        self.last_own_fix.note(state)
        return state

    def _recent(self, at_ns: int) -> list[FilterState]:
        return self._history.between(at_ns - RECENTLY_NS, at_ns)

    def take_proposal(
        self,
        at_ns: int,
        ned_from_body: Array | None,
        world_from_body: Pose,
        covariance: Array,
        points_world: Array,
    ) -> FilterState | NotFused:
        """Take in where a peer says that we were at one of our frames.

        Args:
            at_ns: the frame's instant.
            ned_from_body: (3, 3) attitude of that instant, or None.
            world_from_body: the proposed pose.
            covariance: (6, 6) local, of it.
            points_world: (N, 3) landmarks of the map that the pose is in, m: how far the scene is.

        Returns:
            The state of that instant with the proposal in it, or why it was not taken.
        """
        if ned_from_body is not None:
            options = self._localization
            options = options if self.has_heading else options.of_any_heading()
            reason = disagreement(world_from_body.rotation, ned_from_body, options)
            if reason:
                return NotFused(reason, contradicts=True)
        too_far = self.last_own_fix.too_far(at_ns, world_from_body, covariance)
        if too_far:
            return NotFused(too_far, contradicts=True)
        covariance = self.last_own_fix.no_surer(covariance)
        if self._history.newest is None:
            state = started_from_proposal(
                world_from_body, covariance, at_ns, ned_from_body, self._options
            )
            if self._has_begun:
                self._jump("begun anew by a peer's proposal")
            self._has_begun = True
            self._history.append(state, None, ned_from_body)
            return state
        away_m = np.linalg.norm(points_world - world_from_body.translation, axis=1)
        arm_m = float(np.median(away_m))
        fused = self._history.fuse(at_ns, world_from_body, covariance, max(arm_m, _LEAST_ARM_M))
        if isinstance(fused, NotFused):
            return fused
        return self._history.at(at_ns) or fused

    def carry(self, other_from_world: Similarity) -> None:
        """Go on in another world, whose map takes the place of ours.

        Where the autopilot takes us to be does not change by it, if it is to be so: where its
        frame is in the world does.
        What is still to come of earlier frames is of the world that was left, and not taken.
        """
        newest = self._history.newest
        self._history.clear()
        self._witness.forget()
        if newest is not None:
            there = carried(newest, other_from_world)
            self._history.append(there, None, newest.ned_from_body)
        if self._keeps_local:
            self.local.carry(other_from_world)
        else:
            self.local.leave()
            self._jump("joined another world")
        self.last_own_fix.carry(other_from_world)

    def _is_late(self, at_ns: int) -> bool:
        """Whether a later frame has been taken in already."""
        newest = self._history.newest
        return newest is not None and at_ns < newest.at_ns

    def _begins_anew(self, fix: Localized) -> bool:
        """Count a fix against the state; return whether it is believed now, and the state is not.

        One is wrong; several in a row say that the state is, or that the autopilot has turned
        its north.
        """
        self._n_contradicted += 1
        if self._n_contradicted < _MAX_CONTRADICTED:
            return False
        self._relocalized(fix)
        return True

    def _relocalized(self, fix: Localized) -> None:
        self._jump(f"relocalized with {fix.n_inliers} landmarks", displaces=fix.is_on_map)

    def _jump(self, why: str, *, displaces: bool = True) -> None:
        self.n_resets += 1
        self.n_displaced += displaces
        self._jumped(why)
