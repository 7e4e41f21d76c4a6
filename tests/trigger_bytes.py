"""The bytes of an event, as a unit sends them."""

from oxts_bridge.channels import TRIGGER_CHANNELS, encode_channel


def encode_trigger(channel: int, gps_nanoseconds: int, count: int) -> bytes:
    """The 8 bytes of a trigger channel for an event at a GPS time [ns since 1980-01-06], rounded to 4 us. count:
    1..255."""
    ticks = (gps_nanoseconds + 2_000) // 4_000
    milliseconds, fine = divmod(ticks + 125, 250)
    minutes, milliseconds = divmod(milliseconds, 60_000)
    name = TRIGGER_CHANNELS[channel].removesuffix("Time")
    return encode_channel(
        channel,
        {
            f"{name}Minutes": minutes,
            f"{name}Milliseconds": milliseconds,
            f"{name}Fine": fine - 125,
            f"{name}Count": count,
        },
    )
