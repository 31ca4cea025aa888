"""The command `vcl ground` as a process, whose orders reach drones through their autopilots."""

import asyncio
import sys
from pathlib import Path

from tests.daemon import demo
from tests.daemon.swarm import Drone, swarm
from tests.daemon.waiting import beside, hurry, run
from tests.links.running import Udp, udp
from tests.ports import free_ports


async def forwarded(drone: Drone, air: Udp, ground: tuple[str, int]) -> None:
    """Pass on between a drone and a ground station, as an autopilot does."""
    drone.autopilot.relay = lambda data: air.transport.sendto(data, ground)
    while True:
        data, _ = await air.got.get()
        drone.autopilot.pass_on(data)


async def vcl_ground(port: int, *arguments: str) -> tuple[int, list[str]]:
    """Run the command; return its exit status and what it has printed."""
    hurry(0.0)  # the test's bound counts from here
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "vcl_companion", "ground", *arguments),
        *("--link", f"udpin:127.0.0.1:{port}", "--drone", "1"),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    output, _ = await process.communicate()
    assert process.returncode is not None
    return process.returncode, output.decode().splitlines()


def test_a_drone_does_what_the_command_says(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members, udp() as air:
            one = await members.start(1, flies_on=(1, 2), directory=str(tmp_path))
            await one.see(demo.frame(1, 0))
            (port,) = free_ports(1)
            async with beside(forwarded(one, air, ("127.0.0.1", port))):
                status, lines = await vcl_ground(port, "save-map")
                assert (status, lines[-1]) == (0, "drone 1: has saved its map")
                assert (tmp_path / "saved.vclmap").read_bytes() == demo.encoded_map(1, 2)
                status, lines = await vcl_ground(port, "pause")
                assert (status, lines) == (0, ["drone 1: sends no poses"])
                assert one.autopilot_link.poses.is_paused
                status, lines = await vcl_ground(port, "resume")
                assert (status, lines) == (0, ["drone 1: sends poses again"])
                assert not one.autopilot_link.poses.is_paused
                assert (await vcl_ground(port, "save-map", "--forget"))[0] == 0
                status, lines = await vcl_ground(port, "reload-map")
                assert status == 1
                assert lines[-1] == (
                    "drone 1: could not take it; it says: VCL saved map not taken: there is none"
                )

    run(scenario())
