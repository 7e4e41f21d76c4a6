"""Reads HDF5 files (MATLAB 7.3, pandas tables, one dataset for each signal) as dicts, lists and arrays, the form in
which scipy returns structs of older MATLAB files. Only datasets that are signals or text are read from the disk.
"""

import pickletools
import re
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from .errors import RunError

EXTENSIONS = (".h5", ".hdf5", ".hdf")
MAX_MATRIX_COLUMNS = 32
"""A matrix with more rows and more columns than this is an image or a map; others are split into NAME_1, NAME_2, ..."""
SAMPLE_FIELDS = ("data", "value", "values")
"""Fields of a struct, in lower case, that contain the samples of the signal after which the struct is named."""
UNIT_FIELDS = ("unit", "units", "Unit", "Units")
TIME_CLASSES = {"duration", "datetime"}
LINK, LINK_ADVICE = "link", "also copy that file"
_MAGIC = b"\x89HDF\r\n\x1a\n"
_OPAQUE = 3  # value of MATLAB_object_decode for an object in an undocumented format
_MATLAB_ADVICE = {"timeseries": "{0} = struct('Time', {0}.Time, 'Data', {0}.Data)",
                  "timetable": "writetimetable({0}, '{0}.csv')", "table": "writetable({0}, '{0}.csv')",
                  "duration": "{0} = seconds({0})", "datetime": "{0} = posixtime({0})"}
_TIME_KIND = re.compile(r"(?:datetime|timedelta)64(?:\[(\w+)\])?")


def is_hdf5(file: Path) -> bool:
    """Whether a file is in HDF5 format, with or without the 512-byte header that MATLAB writes."""
    with file.open("rb") as stream:
        head = stream.read(512 + len(_MAGIC))
    return _MAGIC in (head[:len(_MAGIC)], head[512:])


def read_hdf5(file: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """(structs, name -> class of an object that only MATLAB can read, or target of a broken link)."""
    import h5py

    objects: dict[str, str] = {}
    with h5py.File(file, "r", locking=False) as content:
        return _read_group(content, "", objects), objects


def reject_objects(file: Path, objects: dict[str, str]) -> NoReturn:
    """Raises RunError for a broken link, else for the objects, with a MATLAB statement for one of each known class."""
    for name, class_name in objects.items():
        if class_name.startswith(LINK):
            raise RunError(file, f"its {name} is a {class_name}, which cannot be opened", LINK_ADVICE)
    first = {class_name: name for name, class_name in reversed(objects.items())}
    statements = [form.format(first[class_name]) for class_name, form in _MATLAB_ADVICE.items() if class_name in first]
    names = ", ".join(f"{name} ({class_name})" for name, class_name in objects.items())[:200]
    raise RunError(file, f"it contains objects that only MATLAB can read: {names}",
                   "save their samples as vectors or fields of a struct" + (
                       f", for example {'; '.join(statements)}" if statements else ""))


def _read_group(group: Any, path: str, objects: dict[str, str], parents: tuple[Any, ...] = ()) -> Any:
    """The struct in a group, or a list of structs if it is an array. parents: groups that contain the group; links to
    them, or to itself, are not followed. objects: see `read_hdf5`; links to missing files are added."""
    if _to_text(group.attrs.get("pandas_type")) == "frame":
        return _read_frame(group)
    fields: dict[str, Any] = {}
    for name in group:
        node = group.get(name)  # None for a link to a missing file or object
        if node is None and hasattr(link := group.get(name, getlink=True), "filename"):
            objects[f"{path}.{name}" if path else name] = f"{LINK} to {link.path} in the file {link.filename}"
        is_type = hasattr(node, "dtype") and not hasattr(node, "shape")
        if name.startswith("#") or node is None or is_type or _to_text(node.attrs.get("CLASS")) == "TINDEX" or (
                node in (group, *parents)):
            continue  # parts of other variables in MATLAB, a named datatype, an index of PyTables
        value = _read_node(node, f"{path}.{name}" if path else name, objects, (group, *parents))
        unit = next((unit for key in UNIT_FIELDS if (unit := _to_text(node.attrs.get(key)))), "").split(" since ")[0]
        if unit and name.lower() in SAMPLE_FIELDS:
            fields["unit"] = unit
        fields[f"{name} [{unit}]" if unit and name.lower() not in SAMPLE_FIELDS else name] = value
    if fields and _to_text(group.attrs.get("MATLAB_class")) == "struct" and all(
            isinstance(value, list) and "MATLAB_class" not in group[name].attrs for name, value in fields.items()):
        return [dict(zip(fields, entry, strict=True)) for entry in zip(*fields.values(), strict=True)]
    return fields


def _check_samples(dataset: Any) -> None:
    """Raises RunError for samples in a missing file, which HDF5 reads as zeros, or with an unknown compression."""
    from h5py import h5z

    file, name, settings = Path(dataset.file.filename), dataset.name, dataset.id.get_create_plist()
    for source in dataset.virtual_sources() if dataset.is_virtual else ():
        if "%" not in source.file_name and not (file.parent / source.file_name).is_file() and source.file_name != ".":
            raise RunError(file, f"its {name} is a link to the file {source.file_name}, which cannot be opened",
                           LINK_ADVICE)
    for code, _, _, label in map(settings.get_filter, range(settings.get_nfilters())):
        if not h5z.filter_avail(code):
            raise RunError(file, f"its {name} is compressed with {_to_text(label) or 'an unknown filter'} (HDF5 filter "
                           f"{code}), which h5py cannot read", "save it uncompressed or with gzip")


def _read_node(node: Any, path: str, objects: dict[str, str], parents: tuple[Any, ...]) -> Any:
    """The value of a group or dataset; None if it is neither a signal nor text. parents: see `_read_group`."""
    matlab_class = _to_text(node.attrs.get("MATLAB_class"))
    if node.attrs.get("MATLAB_object_decode") == _OPAQUE:
        if matlab_class != "string":
            objects[path] = matlab_class
        return None
    if "MATLAB_empty" in node.attrs or "MATLAB_sparse" in node.attrs:
        return None
    if not hasattr(node, "dtype"):
        return _read_group(node, path, objects, parents)
    if node.dtype.names:
        return None if matlab_class else _read_table(node)  # not a table: MATLAB stores complex numbers as two fields
    if node.dtype.metadata and "ref" in node.dtype.metadata:
        entries = [_read_node(node.file[reference], f"{path}{{{number}}}", objects, parents) if reference else None
                   for number, reference in enumerate(node[()].ravel(), 1)]
        return entries[0] if len(entries) == 1 else entries
    if matlab_class == "char":
        return node[()].astype("<u2").tobytes().decode("utf-16-le", "replace")
    if node.shape == () and node.dtype.kind in "OS":
        return _to_text(node[()])
    sizes = [size for size in node.shape or () if size > 1]
    is_image = len(sizes) > 2 or (len(sizes) == 2 and min(sizes) > MAX_MATRIX_COLUMNS)
    if node.dtype.kind not in "biuf" or not sizes or is_image:
        return None
    _check_samples(node)
    factor, offset = (np.ravel(node.attrs.get(*packing))[0] for packing in (("scale_factor", 1), ("add_offset", 0)))
    array = factor * np.squeeze(_to_native(node[()])) + offset  # packed, as netCDF defines it
    return array.T if matlab_class else array  # MATLAB stores transposed arrays


def _read_table(dataset: Any) -> dict[str, Any]:
    """The columns of a table, with the names that pandas writes into attributes."""
    _check_samples(dataset)
    numeric_names = [name for name in dataset.dtype.names if dataset.dtype[name].base.kind in "biufV"]
    columns = _to_native(dataset.fields(numeric_names)[()].ravel()) if numeric_names else {}
    table: dict[str, Any] = {}
    for field, column in columns.items():
        field_kind, unit = dataset.attrs.get(f"{field}_kind"), _find_unit(dataset.attrs.get(f"{field}_dtype"))
        names = _list_pickled_texts(field_kind)
        if field == "index" and field_kind is not None:
            texts = _list_pickled_texts(dataset.parent.attrs.get("info"))
            name = texts[texts.index("index_name") + 1] if "index_name" in texts[:-1] else ""
            table[_name_index(name, field_kind)] = column
        elif names and np.shape(column)[1:] == (len(names),):
            table |= {name + unit: column[:, number] for number, name in enumerate(names)}
        else:
            table[field + unit] = column
    return table


def _to_native(rows: np.ndarray) -> Any:
    """An array in native byte order; a structured array as a dict of its fields."""
    if rows.dtype.names:
        return {name: _to_native(rows[name]) for name in rows.dtype.names}
    return rows.astype(rows.dtype.newbyteorder("="), copy=False)


def _read_frame(group: Any) -> dict[str, np.ndarray]:
    """The columns of a pandas table in the format "fixed", which has one matrix for each data type."""
    index = group["axis1"]
    columns = {_name_index(_to_text(index.attrs.get("name")).removesuffix("N."), index.attrs.get("kind")): index[()]}
    for number in range(int(group.attrs["nblocks"])):
        values, names = group[f"block{number}_values"], group[f"block{number}_items"]
        _check_samples(values)
        if values.dtype.kind in "biuf":
            unit = _find_unit(values.attrs.get("value_type"))
            columns |= {_to_text(name) + unit: column for name, column in zip(names[()], values[()].T, strict=True)}
    return columns


def _name_index(name: str, time_type: Any) -> str:
    unit = _find_unit(time_type)
    return (name or ("time" if unit else "index")) + unit


def _find_unit(time_type: Any) -> str:
    """Unit suffix of a time type, such as " [ns]" for datetime64[ns] or, from older pandas, datetime64; else empty."""
    match = _TIME_KIND.fullmatch(_to_text(time_type))
    return f" [{match[1] or 'ns'}]" if match else ""


def _list_pickled_texts(content: Any) -> list[str]:
    """The strings in a pickled object, which is not unpickled, because that could run code."""
    if not isinstance(content, bytes) or not content.endswith(b"."):
        return []
    return [text for code, text, _ in pickletools.genops(content) if isinstance(text, str) and (
        "UNICODE" in code.name or "STRING" in code.name)]


def _to_text(value: Any) -> str:
    """An attribute as text; empty for other types."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value if isinstance(value, str) else ""
