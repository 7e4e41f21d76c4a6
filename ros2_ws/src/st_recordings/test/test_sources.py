"""Which files make a run, in folders of all kinds and in run.yaml; what is none says why, and the rest goes on."""

from pathlib import Path

import pytest
from canedge_bridge import extraction
from st_core.vehicle import VehicleParameters
from st_recordings.runs import ReadSettings, RunSource, errors, find_runs, frames, raw, read
from st_recordings.runs.errors import RunError
from st_recordings.runs.raw import read_pair
from support import ROOT

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


def test_extended_identifiers_are_marked_alike():
    assert frames.EXTENDED == extraction.EXTENDED


def test_bounds_the_wrong_way_round_are_refused() -> None:
    source = RunSource("x", "ncom", (Path("x.ncom"),))
    with pytest.raises(RunError, match="--search: the lower bound 5 is not below"):
        raw.choose_clock_settings(source, ReadSettings(search=(5.0, 1.0)))


def test_files_of_one_stem(tmp_path: Path) -> None:
    touch(tmp_path, "s3.ncom", "s3.MF4", "s4.ncom", "s4.log", "notes.txt")
    runs = by_name(find_runs([tmp_path]))
    assert {name: (run.kind, run.problem) for name, run in runs.items()} == {"s3": ("ncom", None), "s4": ("ncom", None)}
    assert [f.name for f in runs["s3"].can] == ["s3.MF4"]
    assert by_name(find_runs([tmp_path / "s4.ncom"]))["s4"].can == (tmp_path / "s4.log",)


def test_one_ins_recording_and_a_loggers_tree(tmp_path: Path) -> None:
    touch(tmp_path, "drive.ncom", "LOG/2F6913DB/00000004/00000001.MF4", "LOG/2F6913DB/00000004/00000002.MF4")
    (run,) = find_runs([tmp_path])
    assert (run.name, run.kind, len(run.can)) == ("drive", "ncom", 2)


def test_files_given_one_by_one(tmp_path: Path) -> None:
    files = touch(tmp_path, "a.ncom", "b.asc", "c.blf")
    (run,) = find_runs(files)
    assert (run.name, run.kind, run.can) == ("a", "ncom", (files[1], files[2]))


def test_what_has_no_partner_says_so(tmp_path: Path) -> None:
    touch(tmp_path, "a.ncom", "b.ncom", "c.log")
    runs = find_runs([tmp_path])
    assert len(runs) == 2
    assert all("give them the same name, or list the files of each run" in str(run.problem) for run in runs)
    alone = find_runs(touch(tmp_path / "alone", "d.log"))
    assert "no INS recording (.ncom, .csv, .vbo, bag) belongs to this CAN log" in str(alone[0].problem)
    raw = find_runs(touch(tmp_path / "raw", "d.log", "d.rd"))
    assert any("d.rd: this is raw data of an OxTS unit: convert it to NCOM" in str(run.problem) for run in raw)
    lonely = find_runs(touch(tmp_path / "lonely", "e.ncom"))
    assert "no CAN log has the same stem" in str(lonely[0].problem)


def test_a_drive_of_a_folder_that_lacks_a_column_is_reported(tmp_path: Path) -> None:
    header, _, body = DRIVE.partition("\n")
    column = next(name for name in header.split(",") if name.lower() in ("vx", "velocity_x"))
    touch(tmp_path, "whole.csv", content=DRIVE)
    touch(tmp_path, "lacks.csv", content=f"{header.replace(column, 'slip', 1)}\n{body}")
    touch(tmp_path, "way.csv", content="x,y,yaw,speed\n0,0,0,1\n1,0,0,1\n")
    runs = by_name(find_runs([tmp_path]))
    assert set(runs) == {"whole", "lacks"}
    with pytest.raises(RunError, match=r"lacks\.csv: no column was recognised as velocity_x"):
        read(runs["lacks"])


def test_a_folder_of_everything(tmp_path: Path) -> None:
    touch(tmp_path, "one.ncom", "one.log", "readme.txt", "photo.png", "sub/table.csv", "empty/nothing.here")
    touch(tmp_path, "genesis.csv", content=DRIVE)
    topics = "rosbag2_bagfile_information: {topics_with_message_count: [%s]}"
    touch(tmp_path, "bag/metadata.yaml", content=topics % "{topic_metadata: {type: nav_msgs/msg/Odometry}}")
    touch(tmp_path, "errors/metadata.yaml", content=topics % "")
    touch(tmp_path, "bag/bag_0.mcap", "errors/errors_0.mcap")
    runs = by_name(find_runs([tmp_path]))
    assert {name: run.kind for name, run in runs.items()} == {"one": "ncom", "genesis": "csv", tmp_path.name: "bag"}
    assert len(read(runs["genesis"]).log.x) == 50
    with pytest.raises(RunError, match=r"one\.ncom: .* give the vehicle file"):
        read(runs["one"])
    leaf = VehicleParameters.from_yaml((ROOT / "config/vehicle/leaf.yaml").read_text(), "leaf.yaml")
    with pytest.raises(RunError, match=r"one\.ncom: the file is empty"):
        read(runs["one"], leaf)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("nowhere.ncom", "the file or folder does not exist; looked for in /"),
        ("note.txt", r"the file or folder does not exist; looked for in .*, did you mean notes\.txt\?"),
        ("notes.doc", r"recordings with the extension \.doc are not supported; give files with .*\.ncom"),
        ("table.lvm", r"recordings with the extension \.lvm are not supported; rename it to \.csv if it is a text"),
        ("capture.pcap", "no CAN log has the same stem"),
        ("unit.bin", r"recordings with the extension \.bin are not supported; rename it to \.ncom if"),
        ("unit.rd", r"recordings with the extension \.rd are not supported; .* convert it to NCOM"),
        ("logger.vbb", r"recordings with the extension \.vbb are not supported; export it as \.vbo"),
        ("car.dbc", r"recordings with the extension \.dbc are not supported; give a DBC with --dbc"),
        ("folder", "this folder contains no recording"),
    ],
)
def test_paths_that_are_no_run(tmp_path: Path, path: str, message: str) -> None:
    touch(tmp_path, "notes.txt", "folder/notes.txt", "notes.doc", "table.lvm", "capture.pcap", "unit.rd", "unit.bin",
          "logger.vbb", "car.dbc")
    (run,) = find_runs([tmp_path / path])
    with pytest.raises(RunError, match=message):
        read(run)


FOREIGN = "Takt,Rechts,Hoch,Kurs,Tempo,Quer,Drehrate\n" + "".join(f"{0.02 * k:.2f},{k},0,0,5,0,0\n" for k in range(50))
FRAMES = "".join(f"({k / 100:.6f}) can0 002#1D000007B0\n" for k in range(100))


def test_a_table_with_foreign_columns_and_its_can_log_are_a_run(tmp_path: Path) -> None:
    files = [*touch(tmp_path, "a.csv", content=FOREIGN), *touch(tmp_path, "a.log", content=FRAMES)]
    leaf = VehicleParameters.from_yaml((ROOT / "config/vehicle/leaf.yaml").read_text(), "leaf.yaml")
    for given in ([tmp_path], files):
        (run,) = find_runs(given)
        assert (run.kind, run.files, run.can) == ("csv", (files[0],), (files[1],))
        with pytest.raises(RunError, match=r"recognised as t, .*; its columns are Takt, .*.*can: .*columns: {t:"):
            read(run, leaf)
    touch(tmp_path, "b.log", content=FRAMES)
    alone = find_runs([tmp_path / "b.log"])
    assert "name unknown columns of a.csv, as columns:" in str(alone[0].problem)


def test_one_run_yaml_for_each_drive_of_a_folder(tmp_path: Path) -> None:
    touch(tmp_path, *(f"{name}.csv" for name in "abcde"), content=FOREIGN)
    touch(tmp_path, "a.log", "d.log", content=FRAMES)
    columns = "columns: {t: Takt, x: Rechts, y: Hoch, yaw: Kurs, velocity_x: Tempo, velocity_y: Quer, yaw_rate: "
    (file,) = touch(tmp_path, "all.run.yaml", content=f"each: '*.csv'\n{columns}Drehrate}}\n")
    (own,) = touch(tmp_path, "b.run.yaml", content=f"csv: b.csv\nname: second\n{columns}Tempo}}\n")
    touch(tmp_path, "c.run.yaml", content="csv: c.csv\ncolumns: {yaw_rte: Drehrate}\n")
    leaf = VehicleParameters.from_yaml((ROOT / "config/vehicle/leaf.yaml").read_text(), "leaf.yaml")
    for given in ([tmp_path], [file]):
        runs = by_name(find_runs(given))
        assert {*runs} == {"a", "second", "c.run.yaml", "d", "e"} and runs["second"].run_file == own
        assert "unknown key yaw_rte" in str(runs["c.run.yaml"].problem)
        assert [name for name, run in runs.items() if run.can] == ["a", "d"]
        assert all(runs[name].settings["layout"].columns["x"] == "Rechts" for name in "ade")
        with pytest.raises(RunError, match="no column was recognised as road_wheel_angle"):
            read(runs["e"], leaf)


def test_each_leaves_drives_to_a_run_file_of_their_own(tmp_path: Path) -> None:
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


def test_a_drive_named_alone_is_read_by_the_each_of_its_folder(tmp_path: Path) -> None:
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


def test_frames_in_a_table_are_no_can_log(tmp_path: Path) -> None:
    touch(tmp_path, "run.ncom", "run.csv", content="Time Stamp,ID,Extended,Dir,Bus,LEN,D1\n")
    (run,) = find_runs([tmp_path])
    assert "no CAN log has the same stem; " in str(run.problem) and "if run.csv is a CAN log, " in str(run.problem)


@pytest.mark.parametrize(("name", "error"), [
    ("a.bag", "convert the ROS 1 bag with rosbags-convert"), ("a.zip", "unpack it first"),
    ("notes.txt", "this folder contains no recording")])
def test_a_folder_without_a_run_names_its_recordings(tmp_path: Path, name: str, error: str) -> None:
    touch(tmp_path, "README.md", f"sub/{name}")
    (run,) = find_runs([tmp_path])
    assert error in str(run.problem)


@pytest.mark.parametrize(("text", "error"), [
    ("each: '*.csv'\nname: x\n", "key name describes one run, but `each` describes several"),
    ("each: '*.csv'\nleave_out: [[1, 2]]\n", "key leave_out describes one run"),
    ("each: '*.tdms'\n", r"no file matches '\*.tdms'"),
    ("each: '*.doc'\n", "a.doc is not a recording"),
    ("each: '*.ncom'\ncolumns: {x: East}\n", "no CAN log in the folder is named a, as a.ncom is"),
])
def test_each_is_of_recordings_that_are_read_alike(tmp_path: Path, text: str, error: str) -> None:
    touch(tmp_path, "a.csv", "a.ncom", "a.doc")
    (run,) = find_runs(touch(tmp_path, "all.run.yaml", content=text))
    with pytest.raises(RunError, match=error):
        read(run, None)


def test_alignment_uses_the_columns_of_the_run_file(tmp_path: Path) -> None:
    touch(tmp_path, "a.csv", content=FOREIGN)
    touch(tmp_path, "a.log", content=FRAMES)
    file, = touch(tmp_path, "a.run.yaml", content="csv: a.csv\ncan: [a.log]\ncolumns: {t: Takt, velocity_x: Tempo, "
                  "yaw_rate: Drehrate}\noffset: 0.5\n")
    pair = read_pair([file], ReadSettings())
    assert pair.ins.velocity[0].tolist() == [5.0] * 50 and pair.alignment.offset_ns == 500_000_000


def test_same_names_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    touch(tmp_path, "monday/drive.csv", "tuesday/drive.csv", content=DRIVE)
    assert sorted(run.name for run in find_runs([tmp_path])) == ["drive", "tuesday_drive"]


def test_a_run_called_run_has_the_name_of_its_folder(tmp_path: Path) -> None:
    touch(tmp_path, "monday/run.csv", "tuesday/run.csv", content=DRIVE)
    assert sorted(run.name for run in find_runs([tmp_path])) == ["monday", "tuesday"]


def test_run_yaml(tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[", "invalid YAML"),
        ("- a", "the file is not a YAML mapping"),
        ("ins: x.ncom\ncan: 1.log\nspeed: 3", "unknown key speed; known keys are name, ins"),
        ("can: 1.log", "exactly one of the keys ins, bag, csv and vbo"),
        ("ins: y.ncom\ncan: 1.log", "ins: 'y.ncom' does not exist"),
        ("csv: e*.csv", r"csv: no file matches 'e\*\.csv'"),
        ("csv: [d.csv, 3]", "csv: expected a file or a list of files"),
        ("ins: x.ncom", "the key can names no CAN log"),
        ("ins: x.ncom\ncan: /logs/*.mf4", "can: '/logs/\\*.mf4' is not a valid pattern"),
        ("ins: x.ncom\ncan: g**", r"can: 'g\*\*' is not a valid pattern"),
        ("ins: x.ncom\ncan: 1.log\noffset: soon", "offset: 'soon' is not a number"),
        ("ins: x.ncom\ncan: 1.log\ndbc:", "dbc: 'None' does not exist"),
        ("ins: x.ncom\ncan: 1.log\nins_can_latency: 0.002", r"ins_can_latency: 0\.002 is not \[latency"),
        ("csv: d.csv\nlabels: [{name: a}]", "labels: expected a list of"),
        ("csv: d.csv\nlabels: [{name: a, start: 5, end: 2}]", "labels: a ends"),
    ],
)
def test_a_run_yaml_that_is_wrong(tmp_path: Path, content: str, message: str) -> None:
    touch(tmp_path, "x.ncom", "1.log", "d.csv")
    (run,) = find_runs(touch(tmp_path, "run.yaml", content=content))
    with pytest.raises(RunError, match=rf"run\.yaml: {message}"):
        read(run)


def test_the_files_of_a_run_yaml_that_is_wrong_are_no_runs_of_their_own(tmp_path: Path) -> None:
    touch(tmp_path, "d.csv", "1.log", "2.log")
    touch(tmp_path, "run.yaml", content="csv: e*.csv\ncan: '*.log'\n")
    (run,) = find_runs([tmp_path])
    assert run.problem is not None and run.name == "run.yaml"


def test_warnings_that_differ_in_file_and_numbers_only_are_logged_once_with_their_files(caplog):
    with errors.group_similar_warnings():
        errors.log_warnings([f"grouped/{k}.csv: {k} of 3000 rows are not used" for k in range(40)])
        errors.log_warnings(["grouped/1.csv: another reason"])
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == errors.MAX_SIMILAR_WARNINGS + 2
    assert lines[0] == "warning: grouped/0.csv: 0 of 3000 rows are not used"
    assert "37 more warnings such as" in lines[-1] and "grouped/3.csv" in lines[-1] and "and 27 more" in lines[-1]


def test_errors_that_differ_in_their_file_only_are_stated_once_with_all_files():
    problems = [f"a/{name}.csv: no column; write a {name}.run.yaml" for name in ("one", "two")]
    text = errors.join_problems([*problems, "b.log: is empty"])
    assert text == "a/one.csv: no column; write a one.run.yaml (the same in a/two.csv); b.log: is empty"
