"""Recordings: readers of NCOM, CAN logs, MF4, bags and CSV; the MCAP writer and its recovery."""
