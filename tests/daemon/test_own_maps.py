"""Maps that were made here: of two at a time one is flown on, and the other goes to nobody."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

from tests.daemon import demo
from tests.daemon.swarm import swarm
from tests.daemon.waiting import run
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of


def test_of_two_maps_that_replace_the_same_one_goes_to_peers(tmp_path: Path) -> None:
    built = decode_map(demo.encoded_update())
    other = replace(built, pixel_noise_px=2.0 * built.pixel_noise_px)
    revisions = [revision_of(encode_map(one)) for one in (built, other)]

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2))
            sharing, current = one.exchange._sharing, one.maps.current
            adopting = [
                asyncio.create_task(sharing.own_maps.adopt(made, current))
                for made in (built, other)
            ]
            went_ahead = set()
            while not all(task.done() for task in adopting):
                if sharing.handing.ahead is not None:
                    went_ahead.add(sharing.handing.ahead.revision)
                await asyncio.sleep(0)
            assert [task.result() for task in adopting] == [None, None]
            assert went_ahead == {revisions[0]}
            assert one.revision == revisions[0]
            assert sharing.handing.ahead is None

    run(scenario())
