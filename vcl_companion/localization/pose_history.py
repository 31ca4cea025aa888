"""The last seconds of a drone's estimates, so that what comes late is fused at its own time.

A peer's proposal says where the drone was when the frame was taken. It is fused
into the state of that instant, and what has been measured since is applied
again on top of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.pose_filter import FilterOptions, predict, update
from vcl_companion.localization.proposals import NotFused, fuse

# A proposal is for a frame's own instant; clocks may round it.
_SAME_INSTANT_NS = 1_000_000


@dataclass(frozen=True, eq=False)
class _Said:
    """A peer's proposal; see ``PoseHistory.fuse``."""

    world_from_body: Pose
    covariance: Array
    arm_m: float

    def into(self, state: FilterState) -> FilterState | NotFused:
        return fuse(state, self.world_from_body, self.covariance, self.arm_m)


@dataclass(frozen=True, eq=False)
class _Step:
    """One frame: the state after it, and what made it so.

    Attributes:
        state: with all of that in it.
        fix: what it gave.
        ned_from_body: (3, 3) attitude of its instant.
        said: what peers have said of it that was taken, in that order.
    """

    state: FilterState
    fix: Localized | None
    ned_from_body: Array | None
    said: tuple[_Said, ...] = ()

    @property
    def fix_on_map(self) -> Localized | None:
        return self.fix if self.fix is not None and self.fix.is_on_map else None


class PoseHistory:
    """States of the recent frames, in order.

    Args:
        length_s: how far back a proposal may reach.
        options: the filter's, to apply measurements again.
        lost_s: how far back, if that is longer, the states since the map was seen well are kept
            of frames that ``has_frame``: a map that comes later may show where they were.

    Attributes:
        has_frame: whether the frame of an instant is still there. A state is a tenth of a
            megabyte with a large map, so only of these.
    """

    def __init__(self, length_s: float, options: FilterOptions, lost_s: float = 0.0) -> None:
        if not length_s > 0:
            raise ValueError(f"length_s must be positive, got {length_s}")
        self._length_ns = round(length_s * 1e9)
        self._lost_ns = round(lost_s * 1e9)
        self.has_frame: Callable[[int], bool] = lambda at_ns: False
        self._options = options
        self._steps: deque[_Step] = deque()

    @property
    def newest(self) -> FilterState | None:
        """The state after the last frame."""
        return self._steps[-1].state if self._steps else None

    def at(self, at_ns: int) -> FilterState | None:
        """Return the state after the frame of an instant; None when it is not remembered."""
        k = self._nearest(at_ns)
        return None if k is None else self._steps[k].state

    def before(self, at_ns: int) -> FilterState | None:
        """Return the state after the last frame that is not later than an instant."""
        earlier = (step.state for step in reversed(self._steps) if step.state.at_ns <= at_ns)
        return next(earlier, None)

    def between(self, from_ns: int, until_ns: int) -> list[FilterState]:
        """Return the states after the frames from an instant on and before another one."""
        return [s.state for s in self._steps if from_ns <= s.state.at_ns < until_ns]

    def own_fix_at(self, at_ns: int) -> FilterState | None:
        """Return the state after the frame of an instant, if the frame gave a fix on the map."""
        return None if self.fix_at(at_ns) is None else self.at(at_ns)

    def fix_at(self, at_ns: int) -> Localized | None:
        """Return what the frame of an instant gave on the map; None when that was nothing."""
        k = self._nearest(at_ns)
        return None if k is None else self._steps[k].fix_on_map

    def clear(self) -> None:
        """Forget everything: the state has begun anew."""
        self._steps.clear()

    def append(
        self, state: FilterState, fix: Localized | None, ned_from_body: Array | None
    ) -> None:
        """Keep the state after a frame; in the place of what it was before, for the last one.

        Args:
            state: predicted to the frame's instant, and updated by its fix if any.
            fix: what the frame gave, or None.
            ned_from_body: (3, 3) attitude of that instant, or None.

        Raises:
            ValueError: the frame is older than the last one.
        """
        if self._steps and state.at_ns < self._steps[-1].state.at_ns:
            raise ValueError("states must come in the order of their time")
        said: tuple[_Said, ...] = ()
        if self._steps and state.at_ns == self._steps[-1].state.at_ns:
            said = self._steps.pop().said  # the new state has it from the old one
        self._steps.append(_Step(state, fix, ned_from_body, said))
        self._forget_before(state.at_ns)

    def fuse(
        self, at_ns: int, world_from_body: Pose, covariance: Array, arm_m: float
    ) -> FilterState | NotFused:
        """Fuse a peer's proposal at its own time, and bring what came since up to date.

        Args:
            at_ns: instant of the frame that the proposal is about, our clock.
            world_from_body: where the peer says that we were.
            covariance: (6, 6) local, of that.
            arm_m: distance of the scene (``covariance_intersection.intersect``).

        Returns:
            The newest state with the proposal in it, or why it was not taken.
        """
        if not self._steps:
            return NotFused("there is no state to fuse with")
        k = self._nearest(at_ns)
        age_ns = self._steps[-1].state.at_ns - at_ns
        if k is None or age_ns > self._length_ns:
            return NotFused(f"no frame of {age_ns * 1e-9:.1f} s ago is remembered")
        step, said = self._steps[k], _Said(world_from_body, covariance, arm_m)
        fused = said.into(step.state)
        if isinstance(fused, NotFused):
            return fused
        if not self._replay(k, replace(step, state=fused, said=(*step.said, said))):
            return NotFused("the state is too old to go on from")
        return self._steps[-1].state

    def refit(self, at_ns: int, fix: Localized) -> FilterState | NotLocalized | None:
        """Take in what a frame gave after later ones had been, and bring these up to date.

        Args:
            at_ns: instant of the frame, which was kept without a fix on the map then.
            fix: what it gave, on the map.

        Returns:
            The state of that instant with the fix in it, or how the fix contradicts it; None
            where it comes too late, or the frame has one.
        """
        k = self._nearest(at_ns)
        if k is None or self._steps[k].fix_on_map is not None:
            return None
        step = self._steps[k]
        state: FilterState | None = step.state
        if step.fix is not None and k > 0:
            # What our own frames told here went on from less than is known by now.
            before = self._steps[k - 1].state
            state = predict(before, step.state.at_ns, step.ned_from_body, self._options)
            state = state and _with_said(state, step.said)
        if state is None:
            return None
        updated = update(state, fix)
        if isinstance(updated, NotLocalized):
            return updated
        if not self._replay(k, replace(step, state=updated, fix=fix)):
            return None
        return updated

    def restart(self, state: FilterState, fix: Localized) -> bool:
        """Begin anew at a frame, and bring what came after it up to date.

        Args:
            state: of that frame's instant, which was kept.
            fix: what it has begun with.

        Returns:
            Whether what came since leads on from there.
        """
        k = self._nearest(state.at_ns)
        return k is not None and self._replay(
            k, replace(self._steps[k], state=state, fix=fix, said=())
        )

    def _replay(self, k: int, changed: _Step) -> bool:
        """Change a step, and apply again what came after it; False where that cannot be."""
        replayed = [changed]
        for step in list(self._steps)[k + 1 :]:
            state = predict(replayed[-1].state, step.state.at_ns, step.ned_from_body, self._options)
            if state is None:
                return False
            if step.fix is not None:
                updated = update(state, step.fix)
                state = updated if isinstance(updated, FilterState) else state
            replayed.append(replace(step, state=_with_said(state, step.said)))
        for n, step in enumerate(replayed):
            self._steps[k + n] = step
        return True

    def _forget_before(self, now_ns: int) -> None:
        """Let go of what is too old, but for what of it may still be found."""
        steps = self._steps
        shown = (s.state.at_ns for s in reversed(steps) if s.fix is not None and s.fix.shows_well)
        shown_at_ns = next(shown, -1)
        old: list[_Step] = []
        while steps[0].state.at_ns < now_ns - self._length_ns:
            old.append(steps.popleft())
        for step in reversed(old):
            at_ns = step.state.at_ns
            if at_ns >= max(shown_at_ns, now_ns - self._lost_ns) and self.has_frame(at_ns):
                steps.appendleft(step)

    def _nearest(self, at_ns: int) -> int | None:
        """Return the place of the step of an instant, None when there is none."""
        places = range(len(self._steps))
        k = min(places, key=lambda k: abs(self._steps[k].state.at_ns - at_ns), default=None)
        if k is None or abs(self._steps[k].state.at_ns - at_ns) > _SAME_INSTANT_NS:
            return None
        return k


def _with_said(state: FilterState, said: Sequence[_Said]) -> FilterState:
    """Return a state with what peers have said of its instant, as far as that fits it still."""
    for one in said:
        fused = one.into(state)
        state = fused if isinstance(fused, FilterState) else state
    return state
