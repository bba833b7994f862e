"""MAVSDK on UDP: mavsdk_client.py PORT. Prints one JSON object: what its plugins made of the bridge."""

import asyncio
import json
import sys
from typing import Any

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.component_metadata import ComponentMetadataAsync
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.component_metadata.component_metadata import MetadataType
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkMessage


async def first(stream: Any, timeout_s: float = 20.0) -> Any:
    """The first thing that a subscription gives."""
    async with asyncio.timeout(timeout_s):
        async for item in stream:
            return item
    return None


async def rate_hz(stream: Any, seconds: float = 3.0) -> float:
    """How often a subscription gives something."""
    count = 0
    loop = asyncio.get_running_loop()
    began = loop.time()
    async for _ in stream:
        count += 1
        if loop.time() - began > seconds:
            break
    return count / (loop.time() - began)


async def main(port: int) -> dict[str, Any]:
    """Connect, look, set."""
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    system = await sdk.first_autopilot(30.0)
    assert system is not None, "no autopilot"
    telemetry, param, direct = TelemetryAsync(system), ParamAsync(system), MavlinkDirectAsync(system)
    found: dict[str, Any] = {"system": await system.get_system_id(), "components": await system.component_ids()}
    attitude = await first(telemetry.subscribe_attitude_euler())
    found["attitude_deg"] = [attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg, attitude.timestamp_us]
    position = await first(telemetry.subscribe_position())
    found["position"] = [position.latitude_deg, position.longitude_deg, position.absolute_altitude_m]
    health = await first(telemetry.subscribe_health())
    found["health"] = {
        name: getattr(health, name)
        for name in (
            "is_gyrometer_calibration_ok",
            "is_accelerometer_calibration_ok",
            "is_home_position_ok",
            "is_armable",
        )
    }
    everything = await param.get_all_params()
    found["parameters"] = {one.name: one.value for one in everything.float_params}
    await param.set_param_float("SR_HUD_HZ", 7.0)
    found["set"] = await param.get_param_float("SR_HUD_HZ")
    await telemetry.set_rate_attitude_euler(20.0)
    await asyncio.sleep(0.5)
    found["attitude_hz"] = await rate_hz(telemetry.subscribe_attitude_euler())
    wanted = asyncio.ensure_future(first(direct.subscribe_message("HOME_POSITION")))
    await asyncio.sleep(0.2)
    request = {"target_system": 1, "target_component": 1, "command": 512, "confirmation": 0, "param1": 242}
    request |= {f"param{i}": 0 for i in range(2, 8)}
    await direct.send_message(MavlinkMessage("COMMAND_LONG", 245, 190, 1, 1, json.dumps(request)))
    found["home"] = json.loads((await wanted).fields_json)["latitude"]
    version = await InfoAsync(system).get_version()
    found["version"] = [version.flight_sw_major, version.flight_sw_minor, version.flight_sw_patch]
    metadata = ComponentMetadataAsync(system)
    await metadata.request_autopilot_component()
    for kind in (MetadataType.PARAMETER, MetadataType.EVENTS):
        for _ in range(100):
            try:
                text = (await metadata.get_metadata(1, kind)).json_metadata
            except Exception:  # not there yet
                await asyncio.sleep(0.2)
            else:
                found[f"metadata_{kind.name.lower()}"] = sorted(json.loads(text))
                break
    sdk.destroy()
    return found


if __name__ == "__main__":
    print(json.dumps(asyncio.run(main(int(sys.argv[1])))))
