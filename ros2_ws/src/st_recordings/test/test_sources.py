"""Which files form a run, in folders of all kinds and in run.yaml; a path that is not a run is reported with the
reason, and the other runs are read."""

from pathlib import Path

import pytest
from canedge_bridge import extraction
from drive_kinds import CAR
from st_recordings.runs import ReadSettings, RunSource, errors, find_runs, frames, raw, read
from st_recordings.runs.errors import RunError
from st_recordings.runs.raw import read_pair

DRIVE = "t,x,y,yaw,vx,vy,yaw_rate,delta\n" + "".join(f"{0.02 * k:.2f},0,0,0,5,0,0,0\n" for k in range(50))


def touch(folder: Path, *names: str, content: str = "") -> list[Path]:
    files = [folder / name for name in names]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    return files


def by_name(runs: list[RunSource]) -> dict[str, RunSource]:
    assert len({run.name for run in runs}) == len(runs)
    return {run.name: run for run in runs}


def test_both_packages_mark_extended_identifiers_with_the_same_bit():
    assert frames.EXTENDED == extraction.EXTENDED


def test_reversed_search_bounds_are_rejected() -> None:
    source = RunSource("x", "ncom", (Path("x.ncom"),))
    with pytest.raises(RunError, match="--search: the lower bound 5 is not below"):
        raw.choose_clock_settings(source, ReadSettings(search=(5.0, 1.0)))


def test_one_path_is_accepted_in_place_of_a_list(tmp_path: Path) -> None:
    touch(tmp_path, "drive.csv", content=DRIVE)
    for path in (tmp_path, str(tmp_path)):
        assert [run.name for run in find_runs(path)] == ["drive"]


def test_files_with_the_same_stem_form_a_run(tmp_path: Path) -> None:
    touch(tmp_path, "s3.ncom", "s3.MF4", "s4.ncom", "s4.log", "notes.txt")
    runs = by_name(find_runs([tmp_path]))
    assert {name: (run.kind, run.problem) for name, run in runs.items()} == {"s3": ("ncom", None), "s4": ("ncom", None)}
    assert [f.name for f in runs["s3"].can] == ["s3.MF4"]
    assert by_name(find_runs([tmp_path / "s4.ncom"]))["s4"].can == (tmp_path / "s4.log",)


def test_single_ins_recording_is_paired_with_all_files_of_a_logger(tmp_path: Path) -> None:
    touch(tmp_path, "drive.ncom", "LOG/2F6913DB/00000004/00000001.MF4", "LOG/2F6913DB/00000004/00000002.MF4")
    (run,) = find_runs([tmp_path])
    assert (run.name, run.kind, len(run.can)) == ("drive", "ncom", 2)


@pytest.mark.parametrize("names", [
    ("{}/ins.ncom", "{}/can.log"), ("day{}/drive{}.ncom", "day{}/LOG/2F6913DB/0000000{}/00000001.MF4"),
    ("{}/ins/a.ncom", "{}/can/00000001.log"), ("ins/drive{}.ncom", "can/drive{}.log")])
def test_drives_in_folders_are_paired_with_the_logs_next_to_them(tmp_path: Path, names: tuple[str, str]) -> None:
    files = {number: touch(tmp_path, *(name.replace("{}", number) for name in names)) for number in "12"}
    runs = find_runs([tmp_path])
    assert sorted((run.files[0], run.can) for run in runs) == [(ins, (log,)) for ins, log in files.values()]
    assert not any(run.problem for run in runs)


def test_recording_takes_all_logs_of_its_own_folder(tmp_path: Path) -> None:
    touch(tmp_path, "d1/a.ncom", "d1/a.log", "d2/b.ncom", "d2/00000001.log", "d2/00000002.log")
    assert {run.name: len(run.can) for run in find_runs([tmp_path]) if not run.problem} == {"a": 1, "b": 2}


def test_numbered_logs_belong_to_the_recording_of_their_stem(tmp_path: Path) -> None:
    touch(tmp_path, "a.ncom", "a.log", "b.ncom", "b_1.log", "b_2.log", "c.ncom", "c_001.log", "c_1.ncom", "c_1.log")
    assert {run.name: [log.name for log in run.can] for run in find_runs([tmp_path])} == {
        "a": ["a.log"], "b": ["b_1.log", "b_2.log"], "c": ["c_001.log"], "c_1": ["c_1.log"]}


@pytest.mark.parametrize(("names", "pairs"), [
    (("d1/a.ncom", "d1/b.log", "d2/b.ncom"), {}),
    (("d1/drive.ncom", "d1/log/00000001.log", "d2/00000001.ncom", "d2/log/00000002.log"), {}),
    (("d1/00000001.log", "d2/00000001.ncom", "d2/log/00000002.log", "d3/c.ncom", "d3/x.log"),
     {"d3/c.ncom": "d3/x.log"}),
    (("d1/a.ncom", "d1/00000001.log", "d2/00000001.ncom", "d2/log/00000001.log"),
     {"d1/a.ncom": "d1/00000001.log", "d2/00000001.ncom": "d2/log/00000001.log"}),
    (("a.ncom", "a.log", "b.ncom", "c.log", "d.log"), {"a.ncom": "a.log"}),
    (("a.ncom", "a.log", "b.ncom", "c.log"), {"a.ncom": "a.log", "b.ncom": "c.log"}),
    (("d1/a.ncom", "d1/log/a.log", "d1/log/b.log", "d2/b.ncom"),
     {"d1/a.ncom": "d1/log/a.log", "d2/b.ncom": "d1/log/b.log"}),
])
def test_recordings_are_not_paired_if_names_and_folders_disagree(
        tmp_path: Path, names: tuple[str, ...], pairs: dict[str, str]) -> None:
    files = touch(tmp_path, *names)
    for given in ([tmp_path], files):
        runs = find_runs(given)
        assert {run.files[0]: run.can for run in runs if not run.problem} == {
            tmp_path / ins: (tmp_path / log,) for ins, log in pairs.items()}
        unpaired = {f for f in files if f.suffix == ".ncom"} - {tmp_path / ins for ins in pairs}
        assert {run.files[0] for run in runs if "do not show which one belongs to it" in str(run.problem)} == unpaired


def test_export_of_an_ncom_file_is_not_a_second_recording(tmp_path: Path) -> None:
    touch(tmp_path, "run.ncom", "run.log")
    touch(tmp_path, "run.csv", content=DRIVE.replace(",delta", "").replace(",0\n", "\n"))
    (run,) = find_runs([tmp_path])
    assert (run.kind, [log.name for log in run.can]) == ("ncom", ["run.log"])


def test_can_log_of_a_complete_drive_is_reported_as_unused(tmp_path: Path) -> None:
    (drive,) = touch(tmp_path, "a.csv", content=DRIVE)
    (log,) = touch(tmp_path, "a.log", content="(1700000000.000000) can0 002#1D000007B0\n")
    for given in ([tmp_path], [drive, log]):
        (run,) = find_runs(given)
        assert read(run).warnings[0] == f"{log}: not used, because a.csv is a complete drive"
    touch(tmp_path, "b.ncom")
    assert {run.name: len(run.can) for run in find_runs([tmp_path])} == {"a": 0, "b": 1}


def test_empty_log_of_a_node_of_a_run_is_not_a_can_log(tmp_path: Path) -> None:
    touch(tmp_path, "drive.csv", content=DRIVE)
    touch(tmp_path, "parameters.yaml", "logs/ros/python_1.log", "logs/passenger.log")
    (run,) = find_runs([tmp_path])
    assert run.problem is None and run.files == (tmp_path / "drive.csv",)


def test_can_log_in_a_folder_with_the_name_of_those_of_the_nodes_is_read(tmp_path: Path) -> None:
    touch(tmp_path, "drive.ncom", "parameters.yaml", "logs/drive.log", content="(1.0) can0 123#01\n")
    assert [len(run.can) for run in find_runs([tmp_path])] == [1]


def test_compressed_can_log_is_to_be_unpacked(tmp_path: Path) -> None:
    (run,) = find_runs(touch(tmp_path, "run.ncom", "run.log.gz")[:1])
    assert str(run.problem).endswith("; run.log.gz: unpack it first")


def test_can_log_that_cannot_be_opened_is_reported(tmp_path: Path, monkeypatch) -> None:
    files = touch(tmp_path, "a.log", "b.blf", content=FRAMES)
    opened = Path.open

    def refuse(path: Path, *arguments, **options):
        if path in files:
            raise PermissionError(13, "Permission denied")
        return opened(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", refuse)
    for given in ([tmp_path], files):
        problems = [str(run.problem) for run in find_runs(given)]
        assert [f"{file}: cannot be read: Permission denied; check its permissions, or copy it again" for file in files
                ] == problems


def test_listed_files_form_one_run(tmp_path: Path) -> None:
    files = touch(tmp_path, "a.ncom", "b.asc", "c.blf")
    (run,) = find_runs(files)
    assert (run.name, run.kind, run.can) == ("a", "ncom", (files[1], files[2]))


def test_recordings_without_a_partner_are_reported(tmp_path: Path) -> None:
    touch(tmp_path, "a.ncom", "b.ncom", "c.log")
    runs = find_runs([tmp_path])
    assert len(runs) == 2
    assert all("give them the same name, or list the files of each run" in str(run.problem) for run in runs)
    only_can = find_runs(touch(tmp_path / "only_can", "d.log"))
    assert "no INS recording (.ncom, .csv, .vbo, bag) matches this CAN log" in str(only_can[0].problem)
    raw_data = find_runs(touch(tmp_path / "raw_data", "d.log", "d.rd"))
    assert any("d.rd: this is raw data of an OxTS unit: convert it to NCOM" in str(run.problem) for run in raw_data)
    only_ins = find_runs(touch(tmp_path / "only_ins", "e.ncom"))
    assert "no CAN log has the same name" in str(only_ins[0].problem)


def test_table_without_a_required_column_is_a_run_with_an_error(tmp_path: Path) -> None:
    header, _, body = DRIVE.partition("\n")
    touch(tmp_path, "complete.csv", content=DRIVE)
    touch(tmp_path, "incomplete.csv", content=f"{header.replace('vx', 'slip', 1)}\n{body}")
    touch(tmp_path, "path.csv", content="x,y,yaw,speed\n0,0,0,1\n1,0,0,1\n")  # without times: not a drive
    runs = by_name(find_runs([tmp_path]))
    assert set(runs) == {"complete", "incomplete"}
    with pytest.raises(RunError, match=r"incomplete\.csv: no column was recognised as velocity_x"):
        read(runs["incomplete"])


def test_folder_with_runs_of_several_kinds_and_other_files(tmp_path: Path) -> None:
    touch(tmp_path, "one.ncom", "one.log", "readme.txt", "photo.png", "sub/table.csv", "empty/nothing.here")
    touch(tmp_path, "genesis.csv", content=DRIVE)
    topics = "rosbag2_bagfile_information: {topics_with_message_count: [%s]}"
    touch(tmp_path, "bag/metadata.yaml", content=topics % "{topic_metadata: {type: nav_msgs/msg/Odometry}}")
    touch(tmp_path, "errors/metadata.yaml", content=topics % "")
    touch(tmp_path, "bag/bag_0.mcap", "errors/errors_0.mcap")
    runs = by_name(find_runs([tmp_path]))
    assert {name: run.kind for name, run in runs.items()} == {"one": "ncom", "genesis": "csv", tmp_path.name: "bag"}
    assert len(read(runs["genesis"]).log.x) == 50
    with pytest.raises(RunError, match=r"one\.ncom: .* specify the vehicle file"):
        read(runs["one"])
    with pytest.raises(RunError, match=r"one\.ncom: the file is empty"):
        read(runs["one"], CAR)


@pytest.mark.parametrize(("path", "message"), [
    ("missing.ncom", "the file or folder does not exist; looked for in /"),
    ("note.txt", r"the file or folder does not exist; looked for in .*, did you mean notes\.txt\?"),
    ("notes.doc", r"recordings with the extension \.doc are not supported; give files with .*\.ncom"),
    ("table.xls", r"recordings with the extension \.xls are not supported; rename it to \.csv if it is a text"),
    ("capture.pcap", "no CAN log has the same name"),
    ("unit.bin", r"recordings with the extension \.bin are not supported; rename it to \.ncom if"),
    ("unit.rd", r"recordings with the extension \.rd are not supported; .* convert it to NCOM"),
    ("logger.vbb", r"recordings with the extension \.vbb are not supported; export it as \.vbo"),
    ("car.dbc", r"recordings with the extension \.dbc are not supported; give this description of CAN messages"),
    ("folder", "this folder contains no recording"),
])
def test_path_that_is_not_a_run_is_rejected(tmp_path: Path, path: str, message: str) -> None:
    touch(tmp_path, "notes.txt", "folder/notes.txt", "notes.doc", "table.xls", "capture.pcap", "unit.rd", "unit.bin",
          "logger.vbb", "car.dbc")
    (run,) = find_runs([tmp_path / path])
    with pytest.raises(RunError, match=message):
        read(run)


UNKNOWN_COLUMNS = "Takt,Rechts,Hoch,Kurs,Tempo,Quer,Drehrate\n" + "".join(
    f"{0.02 * k:.2f},{k},0,0,5,0,0\n" for k in range(50))
FRAMES = "".join(f"({k / 100:.6f}) can0 002#1D000007B0\n" for k in range(100))


def test_table_with_unknown_columns_is_paired_with_its_can_log(tmp_path: Path) -> None:
    files = [*touch(tmp_path, "a.csv", content=UNKNOWN_COLUMNS), *touch(tmp_path, "a.log", content=FRAMES)]
    for given in ([tmp_path], files):
        (run,) = find_runs(given)
        assert (run.kind, run.files, run.can) == ("csv", (files[0],), (files[1],))
        with pytest.raises(RunError, match=r"recognised as t, .*; its columns are Takt, .*.*can: .*columns: {t:"):
            read(run, CAR)
    touch(tmp_path, "b.log", content=FRAMES)
    (unpaired,) = find_runs([tmp_path / "b.log"])
    assert "name unknown columns of a.csv, as columns:" in str(unpaired.problem)


def test_each_describes_all_drives_without_a_run_file(tmp_path: Path) -> None:
    touch(tmp_path, *(f"{name}.csv" for name in "abcde"), content=UNKNOWN_COLUMNS)
    touch(tmp_path, "a.log", "d.log", content=FRAMES)
    columns = "columns: {t: Takt, x: Rechts, y: Hoch, yaw: Kurs, velocity_x: Tempo, velocity_y: Quer, yaw_rate: "
    (file,) = touch(tmp_path, "all.run.yaml", content=f"each: '*.csv'\n{columns}Drehrate}}\n")
    (own,) = touch(tmp_path, "b.run.yaml", content=f"csv: b.csv\nname: second\n{columns}Tempo}}\n")
    touch(tmp_path, "c.run.yaml", content="csv: c.csv\ncolumns: {yaw_rte: Drehrate}\n")
    for given in ([tmp_path], [file]):
        runs = by_name(find_runs(given))
        assert {*runs} == {"a", "second", "c.run.yaml", "d", "e"} and runs["second"].run_file == own
        assert "unknown key yaw_rte" in str(runs["c.run.yaml"].problem)
        assert [name for name, run in runs.items() if run.can] == ["a", "d"]
        assert all(runs[name].settings["layout"].columns["x"] == "Rechts" for name in "ade")
        with pytest.raises(RunError, match="no column was recognised as road_wheel_angle"):
            read(runs["e"], CAR)


def test_drive_that_is_named_alone_is_read_as_its_run_file_says(tmp_path: Path) -> None:
    (drive, _) = touch(tmp_path, "a.csv", "b.csv", content=DRIVE)
    (file,) = touch(tmp_path, "a.run.yaml", content="csv: a.csv\nleave_out: [[0.1, 0.2]]\n")
    for given in ([drive], [drive, file], [tmp_path / "b.csv", drive]):
        (run,) = [run for run in find_runs(given) if drive in run.files]
        assert run.run_file == file and run.settings["leave_out"]
    others = touch(tmp_path, "c.ncom", "c.blf")
    assert {run.run_file for run in find_runs([drive, *others]) if drive in run.files} == {file}
    touch(tmp_path, "a.run.yaml", content="csv: [a.csv, b.csv]\n")
    (run,) = find_runs([drive])
    assert run.run_file is None and run.files == (drive,)
    touch(tmp_path, "a.run.yaml", content="csvv: a.csv\n")
    (run,) = find_runs([drive])
    assert "unknown key csvv, did you mean csv?; known keys are" in str(run.problem)


def test_log_that_is_no_can_log_is_not_called_one(tmp_path: Path) -> None:
    (run,) = find_runs(touch(tmp_path, "a.log", content="$GPGGA,101112.00,5200.00,N\n"))
    assert "a.log: this is not a CAN log of a known format; convert a CAN log to .asc" in str(run.problem)


def test_each_excludes_drives_with_a_run_file(tmp_path: Path) -> None:
    touch(tmp_path, "a.csv", "b.csv", "c.csv", "sub/drive.csv", content=DRIVE)
    touch(tmp_path, "a.log", content="notes of the driver\n")
    touch(tmp_path, "all.run.yaml", content="each: ['[ab].csv', 'sub/*.csv']\n")
    touch(tmp_path, "b.run.yaml", content="csvv: b.csv\n")
    touch(tmp_path, "sub/run.yaml", content="csv: drive.csv\n")
    touch(tmp_path, "parts/p1.csv", "parts/p2.csv", content=DRIVE)
    touch(tmp_path, "parts/run.yaml", content="each: '*.csv'\n")
    touch(tmp_path, "parts/session.run.yaml", content="csv: [p1.csv, p2.csv]\n")
    runs = by_name(find_runs([tmp_path]))
    assert {*runs} == {"a", "b.run.yaml", "c", "sub", "session"} and runs["a"].can == () and runs["b.run.yaml"].problem


def test_single_drive_is_read_with_the_run_file_of_its_folder(tmp_path: Path) -> None:
    a, b, _ = touch(tmp_path, "a.csv", "b.csv", "c.csv", content=DRIVE)
    other, log = touch(tmp_path, "other.ncom", "other.log", content=FRAMES)
    (file,) = touch(tmp_path, "all.run.yaml", content="each: ['[ab].csv', '*.ncom']\noffset: 1.5\n")
    assert [(run.files, run.run_file) for run in find_runs([a, b])] == [((a,), file), ((b,), file)]
    (pair,) = find_runs([other, log])
    assert (pair.can, pair.settings) == ((log,), {"offset": 1.5})
    touch(tmp_path, "mine.log", content=FRAMES)
    (pair,) = find_runs([other, tmp_path / "mine.log"])
    assert (pair.can, pair.run_file) == ((tmp_path / "mine.log",), None)
    assert find_runs([tmp_path / "c.csv"])[0].run_file is None
    file.write_text("each: '*.csv'\noffste: 1\n")
    assert "unknown key offste" in str(find_runs([a])[0].problem)


@pytest.mark.parametrize(("name", "text"), [
    ("run.yaml", "csv: a.csv\noffste: 1\n"), ("run.yaml", "csv: a.csv: b\n"), ("run.yaml", "csv: [a.csv, a_2.csv]\n"),
    ("all.run.yaml", "each: 'a*.csv'\noffste: 1\n")])
def test_invalid_run_file_rejects_only_the_recordings_that_it_names(tmp_path: Path, caplog, name: str,
                                                                    text: str) -> None:
    a, b = touch(tmp_path, "a.csv", "b.csv", content=DRIVE)
    (file,) = touch(tmp_path, name, content=text)
    assert str(find_runs([a])[0].problem).startswith(str(file))
    assert find_runs([b])[0].problem is None and find_runs([b])[0].files == (b,)
    assert [record.getMessage() for record in caplog.records if record.getMessage().startswith(f"warning: {file}")]
    assert "recordings that this file does not name are read without it" in caplog.text
    assert [run.files for run in find_runs([tmp_path]) if run.problem is None] == [(b,)]


@pytest.mark.parametrize(("name", "content"), [
    ("drive_1.csv", b"each: 'drive_[0-9].csv'\nspeeed: 1\n"),
    ("Test drive_1.csv", b"each: 'Test drive_*.csv'\nspeeed: 1\n"),
    ("fahrt_ä.csv", "csv: fahrt_ä.csv\n".encode("latin-1"))])
def test_invalid_run_file_with_a_pattern_rejects_the_recordings_that_match(tmp_path: Path, name: str,
                                                                           content: bytes) -> None:
    (file,) = touch(tmp_path, name, content=DRIVE)
    (tmp_path / "run.yaml").write_bytes(content)
    assert find_runs([file])[0].problem is not None


def test_text_log_of_an_ins_with_the_extension_asc_is_not_a_can_log(tmp_path: Path) -> None:
    touch(tmp_path, "ins.asc", content="#INSPVAXA,COM1,0,73.5,FINESTEERING,1695,309428.000;INS_SOLUTION_GOOD,51.1\n")
    (run,) = find_runs([tmp_path / "ins.asc"])
    assert "ins.asc: this is not a CAN log of a known format; convert a CAN log to .asc" in str(run.problem)


def test_pattern_of_a_run_yaml_leaves_out_can_logs_in_csv(tmp_path: Path) -> None:
    touch(tmp_path, "drive.csv", content="t,x,y,yaw,vx,vy,yaw_rate,delta\n")
    touch(tmp_path, "bus.csv", content="Time Stamp,ID,Extended,Dir,Bus,LEN,D1\n")
    (tmp_path / "all.run.yaml").write_text('each: "*.csv"\n')
    assert [run.name for run in find_runs([tmp_path / "all.run.yaml"])] == ["drive"]


def test_table_of_can_frames_is_not_a_can_log(tmp_path: Path) -> None:
    touch(tmp_path, "run.ncom", "run.csv", content="Time,CAN ID,Dir,Bus,LEN,Bytes\n")
    (run,) = find_runs([tmp_path])
    assert "no CAN log has the same name; " in str(run.problem) and "if run.csv is a CAN log, " in str(run.problem)


@pytest.mark.parametrize(("name", "error"), [
    ("a.zip", "unpack it first"), ("a.tdms", "as .csv, in Python with npTDMS"), ("a.csv", "the file is empty"),
    ("a.bag.active", "the recording was not closed: repair it"), ("notes.txt", "this folder contains no recording"),
    ("oxts/timestamps.txt", "KITTI recordings contain no steering angle"), ("a.json", "contains no recording")])
def test_folder_without_a_run_is_rejected_with_advice_on_its_recordings(tmp_path: Path, name: str, error: str) -> None:
    touch(tmp_path, "README.md", f"sub/{name}")
    (run,) = find_runs([tmp_path])
    with pytest.raises(RunError, match=error):
        read(run)


@pytest.mark.parametrize(("text", "error"), [
    ("each: '*.csv'\nname: x\n", "key name describes one run, but `each` describes several"),
    ("each: '*.csv'\nleave_out: [[1, 2]]\n", "key leave_out describes one run"),
    ("each: '*.tdms'\n", r"no file matches '\*.tdms'"),
    ("each: '*.doc'\n", "a.doc is not a recording; make the pattern match"),
    ("each: '*.ncom'\ncolumns: {x: East}\n", "the folder contains no CAN log with the name a for a.ncom"),
])
def test_invalid_each_is_rejected(tmp_path: Path, text: str, error: str) -> None:
    touch(tmp_path, "a.csv", "a.ncom", "a.doc")
    (run,) = find_runs(touch(tmp_path, "all.run.yaml", content=text))
    with pytest.raises(RunError, match=error):
        read(run)


def test_alignment_uses_the_columns_of_the_run_file(tmp_path: Path) -> None:
    touch(tmp_path, "a.csv", content=UNKNOWN_COLUMNS)
    touch(tmp_path, "a.log", content=FRAMES)
    (file,) = touch(tmp_path, "a.run.yaml", content="csv: a.csv\ncan: [a.log]\ncolumns: {t: Takt, velocity_x: Tempo, "
                  "yaw_rate: Drehrate}\noffset: 0.5\n")
    pair = read_pair([file], ReadSettings())
    assert pair.ins.values["velocity_x"].tolist() == [5.0] * 50 and pair.alignment.offset_ns == 500_000_000


def test_drives_with_the_same_name_get_the_name_of_their_folder_as_prefix(tmp_path: Path) -> None:
    touch(tmp_path, "monday/drive.csv", "tuesday/drive.csv", content=DRIVE)
    assert sorted(run.name for run in find_runs([tmp_path])) == ["drive", "tuesday_drive"]


def test_drive_named_run_gets_the_name_of_its_folder(tmp_path: Path) -> None:
    touch(tmp_path, "monday/run.csv", "tuesday/run.csv", content=DRIVE)
    assert sorted(run.name for run in find_runs([tmp_path])) == ["monday", "tuesday"]


def test_run_yaml_gives_files_and_settings(tmp_path: Path) -> None:
    touch(tmp_path, "x.ncom", "logs/1.log", "logs/2.log", "logs/readme.txt")
    touch(tmp_path, "run.yaml", content="""
        name: monday
        ins: x.ncom
        can: [logs]
        offset: -3.2
        ins_can_latency: [0.004, 0.001]
        labels: [{name: S3, start: 10, end: 20.5}]
        """)
    (run,) = find_runs([tmp_path])
    assert (run.name, run.kind, len(run.can), run.settings["offset"]) == ("monday", "ncom", 2, -3.2)
    assert run.settings["ins_can_latency"] == (0.004, 0.001)
    assert (run.labels[0].name, run.labels[0].end) == ("S3", 20.5)
    (pattern,) = find_runs(touch(tmp_path, "other.run.yaml", content="ins: x.ncom\ncan: logs/*.log\n"))
    assert (pattern.name, len(pattern.can)) == ("other", 2)


@pytest.mark.parametrize(("run_file", "content", "is_valid"), [
    ("run.yaml", "bag: drive_bag\nname: monday\n", True), ("run.yaml", "bag: drive_bag\nnam: monday\n", False),
    ("results/drive.run.yaml", "bag: ../drive_bag\nname: monday\n", True)])
def test_described_bag_folder_is_one_run(tmp_path: Path, run_file: str, content: str, is_valid: bool) -> None:
    touch(tmp_path, "drive_bag/metadata.yaml", "drive_bag/drive_0.mcap", run_file, content=content)
    (run,) = find_runs([tmp_path])
    assert (run.problem is None) is is_valid and (run.name == "monday") is is_valid


@pytest.mark.parametrize(("content", "message"), [
    ("[", "not valid YAML, line 1: "),
    ("- a", "the file is not a YAML mapping"),
    ("ins: x.ncom\ncan: 1.log\nspeed: 3", "unknown key speed; known keys are name, ins"),
    ("can: 1.log", "exactly one of the keys ins, bag, csv and vbo"),
    ("ins: y.ncom\ncan: 1.log", "ins: 'y.ncom' does not exist"),
    ("ins: [x.ncom, y.ncom]\ncan: 1.log", r"ins: .*'x.ncom', 'y.ncom'\]. is not one file"),
    ("csv: e*.csv", r"csv: no file matches 'e\*\.csv'"),
    ("csv: [d.csv, 3]", "csv: expected a file or a list of files"),
    ("ins: x.ncom", "can: no CAN log is listed"),
    ("ins: x.ncom\ncan: /logs/*.mf4", "can: '/logs/\\*.mf4' is not a valid pattern"),
    ("ins: x.ncom\ncan: g**", r"can: 'g\*\*' is not a valid pattern"),
    ("ins: x.ncom\ncan: 1.log\noffset: soon", "offset: 'soon' is not a number"),
    ("ins: x.ncom\ncan: 1.log\ndbc:", "dbc: 'None' does not exist"),
    ("ins: x.ncom\ncan: 1.log\nins_can_latency: 0.002", r"ins_can_latency: 0\.002 is not \[latency"),
    ("csv: d.csv\nlabels: [{name: a}]", "labels: expected a list of"),
    ("csv: d.csv\nlabels: [{name: a, start: 5, end: 2}]", "labels: a ends at 2 s but starts at 5 s"),
])
def test_invalid_run_yaml_is_rejected(tmp_path: Path, content: str, message: str) -> None:
    touch(tmp_path, "x.ncom", "1.log", "d.csv")
    (run,) = find_runs(touch(tmp_path, "run.yaml", content=content))
    with pytest.raises(RunError, match=rf"run\.yaml: {message}"):
        read(run)


def test_files_of_an_invalid_run_yaml_are_not_separate_runs(tmp_path: Path) -> None:
    touch(tmp_path, "d.csv", content=DRIVE)
    touch(tmp_path, "1.log", "2.log")
    touch(tmp_path, "run.yaml", content="csv: e*.csv\ncan: '*.log'\n")
    (run,) = find_runs([tmp_path])
    assert run.problem is not None and run.name == "run.yaml"


def test_warnings_that_differ_only_in_file_and_numbers_are_grouped(caplog):
    with errors.group_similar_warnings():
        errors.log_warnings([f"grouped/{k}.csv: {k} of 3000 rows are not used" for k in range(40)])
        errors.log_warnings(["grouped/1.csv: another reason"])
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == errors.MAX_SIMILAR_WARNINGS + 2
    assert lines[0] == "warning: grouped/0.csv: 0 of 3000 rows are not used"
    assert "37 more such as" in lines[-1] and "grouped/3.csv" in lines[-1] and "and 27 more" in lines[-1]


def test_errors_that_differ_only_in_the_file_are_joined():
    problems = [f"a/{name}.csv: no column; write a {name}.run.yaml" for name in ("one", "two")]
    text = errors.join_problems([*problems, "b.log: is empty"])
    assert text == "a/one.csv: no column; write a one.run.yaml (the same in a/two.csv); b.log: is empty"
