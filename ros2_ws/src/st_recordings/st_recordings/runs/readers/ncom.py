"""Registers the reader of NCOM recordings; the steering is in the CAN logs of the same drive."""

from st_core.vehicle import VehicleParameters

from ..ins_log import InsLog
from ..readers import Reader, register
from ..run_types import LoadedRun, ReadSettings, RunSource


def read_ins(source: RunSource, settings: ReadSettings) -> InsLog:
    from ..ncom import read_ncom

    return read_ncom(source.where)


def read(source: RunSource, vehicle: VehicleParameters | None, settings: ReadSettings) -> LoadedRun:
    from ..raw import read_raw_run  # imports scipy.signal and CAN libraries, which takes two seconds

    return read_raw_run(source, vehicle, settings)


register(Reader("ncom", "ins", (".ncom", ".xcom", ".pcap", ".pcapng", ".cap"), read, read_ins, lacks_steering=None))
