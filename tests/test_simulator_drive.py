"""`simulator drive`: the network that ships stays on the road; what is reported: figures, latencies, a full disk."""

import json
import re
import time

import numpy as np
import pytest
from commands import ROOT, python
from drive_process import serving
from scenes import load
from steer_server import STEER, Server, ahead, drive, unused_port

from cloning.base.errors import OutputError
from cloning.base.outputs import write_json
from cloning.road.track import Track
from simulator import report
from simulator.__main__ import main
from simulator.run import Run


# The mean offsets were measured in lock-step on a CPU, where a drive is the same on every run.
@pytest.mark.parametrize(("track", "mean_offset"), [("lake", 0.071), ("jungle", 0.173)])
def test_the_shipped_network_stays_on_the_road(track, mean_offset, tmp_path):
    laps, report = 150 / Track(track).length, tmp_path / "lap.json"
    with serving("cloning/network/shipped.pt", "--speed", 15, cwd=ROOT) as server:
        drive = ("-m", "simulator", "drive", "--track", track, "--port", server.port, "--report", report)
        done = python(*drive, "--laps", f"{laps:.4f}")
    assert done.returncode == 0, done.stdout + done.stderr
    lap = json.loads(report.read_text(encoding="utf-8"))
    assert lap["departures"] == []
    assert lap["distance_m"] == pytest.approx(150, abs=5)
    assert lap["unusable_answers"] == lap["reconnections"] == 0
    assert 0 < lap["offset_mean_m"] <= 1.3 * mean_offset


def test_a_report_that_cannot_be_written_is_reported_before_the_drive(tmp_path, capsys):
    assert main(["drive", "--report", str(tmp_path / "no" / "report.json")]) == 2
    assert "no such folder" in capsys.readouterr().err
    (road := tmp_path / "road.csv").write_text("0,0\n200,0\n")
    assert main(["drive", "--road", str(road), "--report", str(road)]) == 2
    assert "road.csv: is read, and would be replaced; name another file" in capsys.readouterr().err


def test_the_help_of_a_command_says_what_it_does(capsys):
    with pytest.raises(SystemExit):
        main(["drive", "--help"])
    assert "\n\nLet drive.py drive, and print a lap report.\n\n" in capsys.readouterr().out


def test_steering_goes_out_in_degrees_the_car_obeys_and_the_report_says_what_happened(tmp_path):
    with Server(lambda packet, n: [STEER % ("0.3" if n > 30 else "0", "1")]) as server:
        client = drive(server, laps=0.03)
    telemetries = [json.loads(message[2:])[1] for message in server.messages if message.startswith("42")]
    assert {data["steering_angle"] for data in telemetries} == {"0.0000", "7.5000"}
    assert {departure.side for departure in client.run.departures} == {"right"}
    figures = report.lap_report(client.run, client)
    assert figures["departures"]
    assert figures["ended"] == "laps"
    intervened = 6 * len(figures["departures"])  # s
    assert figures["autonomy"] == pytest.approx(1 - intervened / figures["simulated_seconds"], abs=1e-3)
    assert figures["frames_per_simulated_second"] == pytest.approx(15, abs=0.5)
    printed = report.report_text(figures)
    assert f"departures: {len(figures['departures'])}" in printed
    write_json(tmp_path / "report.json", figures)
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8")) == figures
    report.write_picture(tmp_path / "way.png", client.run)
    assert load(tmp_path / "way.png").std() > 10
    with pytest.raises(OutputError, match="nowhere"):
        write_json(tmp_path / "nowhere" / "report.json", figures)


def test_a_drive_that_never_moved_and_one_lap_are_reported(tmp_path):
    run = Run(Track("lake"))
    report.write_picture(tmp_path / "stood.png", run)
    assert load(tmp_path / "stood.png").std() > 10
    assert report.report_text(report.lap_report(run)).startswith("lake ccw: 0 laps, 0 m")
    run.lap_times.append(80.0)
    assert report.report_text(report.lap_report(run)).startswith("lake ccw: 1 lap, 0 m")


def test_a_drive_that_never_began_leaves_an_earlier_one_s_files(tmp_path, capsys):
    names = [tmp_path / name for name in ("x.mp4", "report.json", "above.png")]
    outputs = [str(word) for pair in zip(("--film", "--report", "--picture"), names, strict=True) for word in pair]
    for name in names:
        name.write_bytes(b"earlier")
    assert main(["drive", "--wait", "0.1", "--port", str(unused_port()), *outputs]) == 2
    assert "no server at" in capsys.readouterr().err
    assert [name.read_bytes() for name in names] == [b"earlier"] * 3


def test_a_round_trip_in_real_time_is_that_of_the_telemetry_that_is_answered():
    """The greeting answers no telemetry, though it comes while the first two are in flight."""
    pause, answered = 0.05, []

    def slowly(packet, n):
        time.sleep(pause)
        answered.append(time.perf_counter())
        return ahead(packet, n)

    with Server(slowly) as server:
        client = drive(server, realtime=True)
    # Three telemetries circulate, and the server answers one at a time.
    assert min(client.round_trips) >= 0.9 * pause
    between = np.median(np.diff(answered))  # 0.05 s and what else a busy machine takes
    assert np.median(client.round_trips) == pytest.approx(3 * between, rel=0.2)


def test_the_exit_status_tells_that_the_car_left_the_road(capsys):
    with Server(lambda packet, n: [STEER % ("1" if n > 15 else "0", "1")]) as server:
        assert main(["drive", "--laps", "0.012", "--port", str(server.port)]) == 1
    assert int(re.findall(r"departures: (\d+)", capsys.readouterr().out)[0]) > 0


def test_a_full_disk_costs_the_film_alone(tmp_path, capsys, longest_file):
    def fills_up(packet, n):
        # The first frames of the film fit, then nothing does, until the drive is nearly over.
        if n in (21, 170):
            longest_file(*[10] * (n == 21))
        return [STEER % ("0", "0.3")]

    names = [tmp_path / name for name in ("x.mp4", "report.json", "above.png")]
    outputs = [str(word) for pair in zip(("--film", "--report", "--picture"), names, strict=True) for word in pair]
    with Server(fills_up) as server:
        assert main(["drive", "--laps", "0.05", "--port", str(server.port), *outputs]) == 2
    printed = capsys.readouterr()
    assert re.search(r"python: \S+x\.mp4: .*no film was written", printed.err)
    assert "departures: " in printed.out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["above.png", "report.json"]
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["distance_m"] > 20
    assert load(tmp_path / "above.png").std() > 10


def test_all_maps_have_one_scale_of_colours(tmp_path):
    run = Run(Track("lake"))
    drive = run.trajectory
    for x, y, _ in np.repeat(run.track.points[:600], 5, axis=0):  # of which every fifth is drawn
        for values, value in zip((drive.x, drive.y, drive.offset, drive.speed), (x, y, 0.5, 25.0), strict=True):
            values.append(float(value))
    teal = (142, 146, 32)  # BGR of viridis at 0.5
    drawn = []
    for furthest in (0.5, 3.0):
        drive.offset[-5:] = [furthest] * 5
        report.write_picture(tmp_path / "map.png", run)
        drawn.append((np.abs(load(tmp_path / "map.png").astype(int) - teal).max(axis=2) < 8).sum())
    assert drawn[0] > 2000 and drawn[1] > 0.9 * drawn[0], drawn
