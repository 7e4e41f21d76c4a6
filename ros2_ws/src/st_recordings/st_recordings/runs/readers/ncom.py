"""Registers the reader of NCOM recordings; the steering is in the CAN logs of the same drive."""

from ..ins_log import InsLog
from ..readers import Reader, register
from ..run_types import ReadSettings, RunSource


def read_ins(source: RunSource, settings: ReadSettings) -> InsLog:
    from ..ncom import read_ncom

    return read_ncom(source.path)


register(Reader("ncom", "ins", (".ncom", ".xcom", ".pcap", ".pcapng", ".cap"), None, read_ins))
