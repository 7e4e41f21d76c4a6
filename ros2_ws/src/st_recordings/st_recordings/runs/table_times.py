"""Reads the times of a table: dates and times of day, seconds of a day or week, and times since 1970 in any unit."""

import re
from contextlib import suppress
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
from canedge_bridge.units import UNITS

from .columns import ColumnSource
from .errors import RunError, format_count
from .ins_log import LATEST_TIME, MAX_LOST_FRACTION, select_usable_rows

# Time zone name -> hours ahead of UTC; sources: RFC 5322, and the tz database
_ZONES = {"Z": 0, "UTC": 0, "GMT": 0, "EST": -5, "EDT": -4, "CST": -6, "CDT": -5, "MST": -7, "MDT": -6, "PST": -8,
          "PDT": -7, "BST": 1, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2, "EET": 2, "EEST": 3, "JST": 9, "KST": 9}
# 2026-05-04T10:11:12.5Z, 2026-05-04 10:11:12, 04.05.26 10:11:12,5, 10:11:12:500, 11:12:13.5 PM (CEST). Java writes
# 10:11:12+02:00[Europe/Berlin], spreadsheets 11:12.5. 05/04/2026 is ignored if _order_dates cannot convert it.
_STAMP = re.compile(r"(?:(?:(\d{4})[-/.](\d\d?)[-/.](\d\d?)|(\d\d?)\.(\d\d?)\.(\d{4}|\d\d)|"
                    r"\d\d?[/-]\d\d?[/-](?:\d{4}|\d\d))[T ,.] *)?(?:0 days )?(?:(\d{1,2}):)?(\d\d?):"
                    rf"(\d\d(?:[.,:]\d+)?) *(?:([AaPp])\.?\s?[Mm]\.?)? *\(?({'|'.join(_ZONES)})?\)?"
                    r"(?:([+-])(\d\d)(?::?(\d\d))?(?:\[\w+/[\w/+-]+\])?)?")
_COMPACT_STAMP = re.compile(r"(\d{4})-?(\d\d)-?(\d\d)[T_ -](\d\d)[:-]?(\d\d)[:-]?(\d\d)(?!\d)")  # 20260504T101112.5
_UNDERSCORED_STAMP = re.compile(r"(\d{4})_(\d\d?)_(\d\d?)_(\d\d?)_(\d\d)_(\d\d)(?:_(\d+))?")  # 2026_05_04_10_11_12_500
_NUMERIC_DATE = re.compile(r"(?<!\d)(\d\d?)[/-](\d\d?)[/-](\d{4}|\d\d)(?!\d)")
_YEAR_LAST = re.compile(r"(?:[^\W\d]+\.? )?([^\W\d]{3,}) +(\d\d?) (\d.*) (\d{4})")  # Mon May 04 10:11:12 GMT+02:00 2026
_MONTH_FIRST = re.compile(r"([^\W\d]{3,})\.? (\d\d?)[,.]? +(\d{4})(?!\d)")  # May 4, 2026
# 04-May-2026, as MATLAB writes it, or Mon, 4 May 2026, as in RFC 5322
_NAMED_MONTH = re.compile(r"(?:[^\W\d]+\.?,? )?(?<!\d)(\d\d?)[- ]([^\W\d]{3,})\.?[- ](\d{4}|\d\d)(?![\d:])")
# First letters of month names in Czech, Danish, Dutch, English, Finnish, French, German, Hungarian, Italian, Norwegian,
# Polish, Portuguese, Romanian, Russian, Spanish, Swedish and Turkish -> number; Vector's tools write month names in the
# language of the computer.
_MONTHS = {name: number for number, names in enumerate((
    "jan jän gen ene sty led ian oca янв tam", "feb fév fev lut úno şub фев hel",
    "mar mär mrz mrt maa már bře мар", "apr avr abr kwi dub ápr nis апр huh", "may mai mag maj mei máj kvě май мая tou",
    "jun juin giu cze čvn jún iun haz июн kes", "jul juil lug lip čvc júl iul tem июл hei",
    "aug aoû ago sie srp ağu авг elo", "sep set wrz zář sze eyl сен syy", "oct okt ott out paź říj eki окт lok",
    "nov lis noi kas ноя marr", "dec dez déc dic des gru pro ara дек jou"), 1) for name in names.split()}
ROLLOVER_STEP = 60.0  # s, longest step of numeric times across midnight or the end of a GPS week
# (day number of 1970-01-01, name of the scale)
_DAY_COUNTS = ((719529.0, "MATLAB date numbers"), (25569.0, "spreadsheet date numbers"), (2440587.5, "Julian dates"))
PLAUSIBLE_EPOCH = (9.46e8, 4.1e9)  # s since 1970, years 2000 to 2099
DAY, HOUR = 86400.0, 3600.0  # s
MAX_REMAINING_BACKWARD = 0.1
"""Zeros are added to fractions of a second if at most this fraction of the backward steps remains."""
MIN_UNUSABLE_STEP = 5.0  # s, duration of a prediction; numbers with larger steps are probably not seconds
HHMMSS = "HHMMSS"  # unit of a time column that contains times of day as numbers HHMMSS.ss
MAX_DAMAGED_FRACTION = 0.01  # up to this fraction of the times in a column of unit HHMMSS may be invalid


def month_number(name: str) -> int | None:
    """Number (1 to 12) of a month by its name in a language of `_MONTHS`, or as 5月; None for an unknown name."""
    name = name.lower().rstrip(".月월")
    return int(name) if name.isdecimal() else _MONTHS.get(name[:4]) or _MONTHS.get(name[:3])


def read_stamps(file: Path, cells: list[str], warnings: list[str]) -> np.ndarray | None:
    """Seconds (n,) of a column of dates and times of day, NaN for other cells; None if the first cell is not a time.
    Times of day continue past midnight."""
    cells = [_YEAR_LAST.sub(r"\2 \1 \4 \3", cell) for cell in cells]
    if (match := _MONTH_FIRST.search(cells[0])) and month_number(match[1]):
        cells = [_MONTH_FIRST.sub(r"\2 \1 \3", cell) for cell in cells]
    if (match := _NAMED_MONTH.search(cells[0])) and month_number(match[2]):
        cells = [_NAMED_MONTH.sub(lambda named: f"{_read_year(named[3])}-{month_number(named[2]) or 0:02d}-{named[1]}",
                                  cell) for cell in cells]
    if not (stamp := parse_stamp(cells[0])):
        return None
    if stamp[1] and _NUMERIC_DATE.search(cells[0]):  # no date was recognised; 10-25-30 may also be a time
        cells = _order_dates(file, "\n".join(cells), warnings).split("\n")
    seconds, periods = np.array([parse_stamp(cell) or (np.nan, 0.0) for cell in cells]).T
    for period in {DAY, HOUR}.intersection(periods):
        seconds[periods == period] += period * count_rollovers(seconds[periods == period], period / 2)
    return seconds


def pad_fractions(file: Path, seconds: np.ndarray, cells: list[str], warnings: list[str]) -> np.ndarray:
    """Seconds of cells such as 17.5000000 for 17 s and 5 ms, with zeros added; `seconds` if too many backward steps
    remain (MAX_REMAINING_BACKWARD), because these have another cause."""
    parts = [cell.partition(".") for cell in cells]
    width = max(len(fraction) for _, _, fraction in parts)
    padded_cells = [f"{whole}.{fraction.zfill(width)}" for whole, _, fraction in parts]
    with suppress(ValueError):  # a cell is not a number
        padded = np.array(padded_cells, float)
        if (np.diff(padded) < 0.0).sum() <= MAX_REMAINING_BACKWARD * (np.diff(seconds) < 0.0).sum():
            warnings.append(f"{file}: zeros were added after the decimal point of its times, as in {padded_cells[1]}")
            return padded
    return seconds


def _order_dates(file: Path, body: str, warnings: list[str]) -> str:
    """Converts dates such as 25/04/2026, 25-04-2026 or 04/25/26 to 2026-04-25 if one shows which number is the day, or
    warns. 25/04/26 is ambiguous: its year may be first."""
    dates = {(int(a), int(b), int(year)) for a, b, year in _NUMERIC_DATE.findall(body) if int(a) <= 31 and int(b) <= 31}
    day_first, month_first = any(a > 12 for a, _, _ in dates), any(b > 12 for _, b, _ in dates)
    if day_first != month_first and (month_first or all(year > 99 for _, _, year in dates)):
        month, day = (2, 1) if day_first else (1, 2)
        return _NUMERIC_DATE.sub(lambda date: f"{_read_year(date[3])}-{date[month]}-{date[day]}", body)
    if dates:
        warnings.append(f"{file}: the order of day, month and year in its dates is ambiguous, so only the time of day "
                        "is used; export dates such as 2026-04-25")
    return body


def _read_year(digits: str) -> int:
    return int(digits) + (2000 if len(digits) == 2 else 0)


def parse_stamp(text: str) -> tuple[float, float] | None:
    """Reads a time: (seconds since 1970, since midnight or since the full hour; period [s] after which they restart, or
    0). A time without time zone is UTC. None for a text that is not a time."""
    if match := _UNDERSCORED_STAMP.fullmatch(text):
        text = "{}-{}-{} {}:{}:{}.{}".format(*match.groups("0"))
    match = _STAMP.fullmatch(_COMPACT_STAMP.sub(r"\1-\2-\3 \4:\5:\6", text))
    if match is None:
        return None
    year, month, day, day_2, month_2, year_2, hour, minute, second, am_pm, zone, sign, hours, minutes = match.groups()
    if not hour and (year or year_2 or not re.search("[.,]", second)):
        return None  # 10:11 is hours and minutes, 11:12.5 minutes and seconds
    seconds = int(hour or 0) * 3600 + int(minute) * 60 + float(re.sub("[,:]", ".", second))
    if am_pm:
        seconds = seconds % (DAY / 2) + (DAY / 2 if am_pm in "Pp" else 0.0)
    seconds -= _ZONES[zone or "Z"] * HOUR
    if sign:
        seconds -= float(f"{sign}1") * (int(hours) * 3600 + int(minutes or 0) * 60)
    if not (year or year_2):
        return seconds, DAY if hour else HOUR
    try:
        calendar_date = date(_read_year(year or year_2), int(month or month_2), int(day or day_2))
    except ValueError:
        return None
    return seconds + (calendar_date - date(1970, 1, 1)).days * DAY, 0.0


def convert_to_seconds(file: Path, times: np.ndarray, source: ColumnSource, warnings: list[str]
                       ) -> tuple[np.ndarray, ColumnSource]:
    """(times [s] without rollovers, their source). Times are in the stated unit, or HHMMSS, days, or ms to ns since a
    fixed date. A column declared as HHMMSS that contains other times is read as seconds, as if it had no unit."""
    finite = times[np.isfinite(times)]
    if source.unit == HHMMSS and not _is_mostly_hhmmss(finite):
        warnings.append(f"{file}: its times are not HHMMSS; they were read as if no unit were stated")
        source = replace(source, unit="s", has_stated_unit=False)
    median, steps = np.median(np.abs(finite)) if len(finite) else 0.0, np.abs(np.diff(finite))
    steps = steps[steps > 0.0]  # a coarse clock repeats its times
    scales: list[tuple[float, float, str]] = []  # (origin, factor to s, description)
    if source.unit == HHMMSS or (not source.has_stated_unit and _is_hhmmss(finite)):
        if source.unit != HHMMSS:
            warnings.append(f"{file}: times of column {source.name} were read as HHMMSS, a time of day")
        seconds = times // 10000 * HOUR + times // 100 % 100 * 60 + times % 100
        seconds[~is_valid_hhmmss(times)] = np.nan
        known_rows = np.isfinite(seconds)
        seconds[known_rows] += DAY * count_rollovers(seconds[known_rows], DAY / 2)
        return seconds, source
    if median > LATEST_TIME:
        scales = [(0.0, UNITS["time"][unit][0], f"{unit} since 1970") for unit in ("ms", "us", "ns")]
        scales += [(1.16444736e17, 1e-7, "0.1 us since 1601"), (6.21355968e17, 1e-7, "0.1 us since the year 1")]
    elif len(steps) and np.median(steps) < 2e-5:  # steps too short for seconds
        scales = [(origin, DAY, f"{name} (UTC)") for origin, name in _DAY_COUNTS]
    for origin, factor, description in scales if not source.has_stated_unit else ():
        if PLAUSIBLE_EPOCH[0] <= (median - origin) * factor <= PLAUSIBLE_EPOCH[1]:
            warnings.append(f"{file}: times of column {source.name} were read as {description}")
            return (times - origin) * factor, source
    step = float(np.median(steps)) if len(steps) else 0.0
    if step >= MIN_UNUSABLE_STEP and not source.has_stated_unit and (unit := _guess_time_unit(times)):
        warnings.append(f"{file}: its times, {step:g} apart, were read in {unit}; if that is wrong, declare their "
                        "unit in a run.yaml, as units: {t: s}")
        source = replace(source, unit=unit)
    seconds = times * source.factor
    known_rows = np.flatnonzero(np.isfinite(seconds))
    # (period, longest step) of seconds of a minute, hour, day or GPS week, and of micro- or milliseconds in 32 bits
    for period, longest_step in ((60.0, 1.0), (HOUR, 1.0), (2**32 * 1e-6, 1.0), (2**32 * 1e-3, 1.0),
                                 (DAY, ROLLOVER_STEP), (7 * DAY, ROLLOVER_STEP)):
        if len(known_rows) and seconds[known_rows].min() >= 0.0 and seconds[known_rows].max() <= period + 1.0 and (
                period > 60.0 or seconds[known_rows[0]] >= 1.0):  # if they begin at 0, they may be joined drives
            seconds[known_rows] += period * count_rollovers(seconds[known_rows], period - longest_step)
    return seconds, source


def count_rollovers(seconds: np.ndarray, min_jump: float) -> np.ndarray:
    """Number of rollovers before each time. A backward jump that the next jump reverses is a wrong time, such as 0."""
    jumps = np.diff(seconds, prepend=seconds[:1])
    rows = np.flatnonzero(np.abs(jumps) > min_jump)
    is_reversed = np.append(seconds[rows[1:]], -np.inf) >= seconds[rows - 1]
    return np.cumsum(np.isin(np.arange(len(seconds)), rows[(jumps[rows] < 0) & ~is_reversed]))


def is_valid_hhmmss(hhmmss: np.ndarray) -> np.ndarray:
    """Whether numbers are times of day HHMMSS.ss, at most one second after 24:00:00."""
    return (hhmmss >= 0.0) & (hhmmss < 240001.0) & (hhmmss % 100 < 60) & (hhmmss // 100 % 100 < 60)


def _is_mostly_hhmmss(times: np.ndarray) -> bool:
    """Whether all numbers but the last, which may be truncated, and a few damaged ones are valid HHMMSS.ss."""
    is_invalid = ~is_valid_hhmmss(times[:-1])
    has_three_in_a_row = (is_invalid[:-2] & is_invalid[1:-1] & is_invalid[2:]).any()
    return bool(is_invalid.sum() <= MAX_DAMAGED_FRACTION * len(is_invalid) and not has_three_in_a_row)


def _is_hhmmss(times: np.ndarray) -> bool:
    """Whether all numbers are valid HHMMSS.ss and a step exceeds the median step by 40, as at the start of a minute."""
    if len(times) < 3 or not is_valid_hhmmss(times).all():
        return False
    steps = np.diff(times)
    median = float(np.median(np.abs(steps)))
    return bool(median < 5.0 and (np.abs(steps % 4000 - 40.0 - median) < median + 0.01).any())


def select_usable_times(file: Path, seconds: np.ndarray, source: ColumnSource, first_time: str | None,
                        warnings: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(whether each row has a time, the times [ns], whether each is usable). Raises RunError for invalid times."""
    has_time = np.abs(seconds) <= LATEST_TIME
    if first_time is not None and len(seconds) and not np.isfinite(seconds).any():
        raise RunError(file, f"no time in column {source.name} can be read; the first is {first_time!r}",
                       "export seconds, or date and time with seconds such as 2026-05-04 10:11:12.3")
    magnitudes = np.abs(seconds[np.isfinite(seconds)])
    if len(magnitudes) and has_time.sum() < 0.5 * len(magnitudes):
        unit = _guess_time_unit(seconds)
        raise RunError(file, f"times such as {magnitudes.max():.3g} in column {source.name} cannot be in {source.unit}",
                       f"declare their unit in a run.yaml, as units: {{t: {unit}}}" if unit else "export seconds")
    # A float of seconds since 1970 resolves microseconds only.
    time_ns = np.round(seconds[has_time] * 1e6).astype(np.int64) * 1000
    rows, row_warnings = select_usable_rows(time_ns, "rows") if len(time_ns) else (np.empty(0, np.int64), [])
    is_usable = np.zeros(len(time_ns), dtype=bool)
    is_usable[rows] = True
    n_backward = int(np.sum(np.diff(time_ns) < 0))
    if 2 * len(rows) < len(time_ns) and n_backward > MAX_LOST_FRACTION * len(time_ns):
        raise RunError(file, f"the times in column {source.name} are not in order: "
                       f"{format_count(n_backward, len(time_ns), 'rows')} have an earlier time than the previous row",
                       "sort the rows by time; if the column contains time steps, export their cumulative sum")
    warnings += [f"{file}: {warning}" for warning in row_warnings]
    if 2 * is_usable.sum() < len(is_usable) and not (time_ns % 10**9).any():
        warnings.append(f"{file}: column {source.name} has only whole seconds, each in many rows; export fractions of "
                        "a second")
    step = float(np.median(np.diff(time_ns[is_usable])) * 1e-9) if is_usable.sum() > 2 else 0.0
    if not source.has_stated_unit and (step >= 1.0 or 0.0 < step < 5e-4):
        warnings.append(f"{file}: its times are {step:g} s apart; if they are not in seconds, declare their unit in a "
                        f"run.yaml, as units: {{t: {'ms' if step >= 1.0 else 'min' if step > 2e-5 else 'h'}}}")
    return has_time, time_ns, is_usable


def _guess_time_unit(times: np.ndarray) -> str:
    """Unit in which all times are before LATEST_TIME and the median step is 0.5 ms to 0.5 s; empty if there is none."""
    times = times[np.isfinite(times)]
    step = np.abs(np.diff(times))
    median_step = float(np.median(step[step > 0.0])) if step.any() else 0.0
    largest = float(np.abs(times).max())
    return next((unit for unit in ("ms", "us", "ns") if 5e-4 <= median_step * (factor := UNITS["time"][unit][0]) < 0.5
                 and largest * factor <= LATEST_TIME), "")
