"""Files as well-known instruments export them, of one motion: force in N, position in m.

Each function writes the table of a `Motion` in the form of one program, with the header, number
signs, units and time stamps that this program uses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]

MASS_KG, DAMPING_N_S_M, STIFFNESS_N_M = 1.0, 2.0, 50.0
RATE_HZ = 200.0
NEWTON_PER_VOLT, METRE_PER_VOLT = 2.0, 0.02
"""Scales of the sensors that an oscilloscope measures."""
_HOLD_ROWS = 8
_NOISE_M = 1e-6
_START = datetime(2024, 5, 17, 9, 41, 2, tzinfo=UTC)


@dataclass(frozen=True)
class Motion:
    """A record of a mass on a spring: time in s, held force in N and position in m, each (N,)."""

    time_s: Array
    force_n: Array
    position_m: Array


@dataclass(frozen=True)
class Channel:
    """What a user knows of a column: its name in the file, or number, and the scale to SI.

    scale: None if the file states the unit.
    """

    column: str | int
    scale: float | None = None


@dataclass(frozen=True)
class Export:
    """A file of an instrument, and what a user knows beside it.

    suffix: of the file's name. known: keys of the SIGNALS.yaml that the draft asks for, such as the
    unit of the time. tick_s: unit of the time if it is a counter.
    """

    suffix: str
    content: bytes
    force: Channel
    position: Channel
    known: tuple[tuple[str, object], ...] = ()
    tick_s: float | None = None


def motion(rows: int = 4000, seed: int = 1) -> Motion:
    """Simulate the mass exactly under a random force that is held for some rows."""
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.standard_normal(rows // _HOLD_ROWS + 1), _HOLD_ROWS)[:rows]
    continuous = np.zeros((3, 3))
    continuous[0, 1] = 1.0
    continuous[1] = np.array([-STIFFNESS_N_M, -DAMPING_N_S_M, 1.0]) / MASS_KG
    step = expm(continuous / RATE_HZ)
    state = np.zeros(2)
    position = np.empty(rows)
    for row in range(rows):
        position[row] = state[0]
        state = step[:2, :2] @ state + step[:2, 2] * force[row]
    position += _NOISE_M * rng.standard_normal(rows)
    return Motion(np.arange(rows) / RATE_HZ, force, position)


def _table(columns: Sequence[Sequence[str] | Array], separator: str, form: str = "%.7g") -> str:
    texts = [
        [form % value for value in column] if isinstance(column, np.ndarray) else column
        for column in columns
    ]
    return "".join(separator.join(cells) + "\n" for cells in zip(*texts, strict=True))


def _volts(m: Motion) -> tuple[Array, Array]:
    return m.force_n / NEWTON_PER_VOLT, m.position_m / METRE_PER_VOLT


def _scope(force: str | int, position: str | int) -> tuple[Channel, Channel]:
    return Channel(force, NEWTON_PER_VOLT), Channel(position, METRE_PER_VOLT)


def _german(text: str) -> str:
    return text.replace(".", ",")


def tektronix_tds(m: Motion) -> Export:
    """Old Tektronix: settings in the first columns of the first rows, no names."""
    u, y = _volts(m)
    settings = [
        f"Record Length,{len(u):e}",
        f"Sample Interval,{1 / RATE_HZ:e}",
        "Trigger Point,1.250000000000e+02",
        *[","] * 3,
        "Source,CH1",
        "Vertical Units,V",
        "Vertical Scale,5.000000e-01",
        "Vertical Offset,0.000000e+00",
        "Horizontal Units,s",
        "Horizontal Scale,2.000000e-01",
        "Pt Fmt,Y",
        "Yzero,0.000000e+00",
        "Probe Atten,1.000000e+00",
        "Model Number,TDS2014B",
        "Serial Number,C012345",
        "Firmware Version,FV:v22.01",
    ]
    left = [*settings, *[","] * (len(u) - len(settings))]
    rows = "".join(
        f"{s},,{t - 0.25:014.9f},{a:9.5f},{b:9.6f},\n"
        for s, t, a, b in zip(left, m.time_s, u, y, strict=True)
    )
    return Export(".csv", rows.encode(), *_scope(4, 5))


def tektronix_mso(m: Motion) -> Export:
    """Newer Tektronix: entries above the header, units in the line `Vertical Units`."""
    u, y = _volts(m)
    head = (
        f"Model,MSO24\nFirmware Version,2.2.8\n\nWaveform Type,ANALOG\nPoint Format,Y\n"
        f"Horizontal Units,s\nHorizontal Scale,1\nHorizontal Delay,0\n"
        f"Sample Interval,{1 / RATE_HZ:g}\nRecord Length,{len(u)}\nGating,0.0% to 100.0%\n"
        "Probe Attenuation,1,10\nVertical Units,V,V\nVertical Offset,0,0\nVertical Scale,1,0.5\n"
        ",,\n,,\nLabel,Force sensor,Position sensor\nTIME,CH1,CH2\n"
    )
    return Export(".csv", (head + _table([m.time_s, u, y], ",")).encode(), *_scope("CH1", "CH2"))


def keysight_infiniivision(m: Motion) -> Export:
    """Keysight: `x-axis,1,2`, units in words."""
    u, y = _volts(m)
    text = "x-axis,1,2\nsecond,Volt,Volt\n" + _table([m.time_s - 10, u, y], ",", "%+.9E")
    return Export(".csv", text.encode(), *_scope("1", "2"))


def rigol_ds1000z(m: Motion) -> Export:
    """Rigol: a sequence number for the time, start and increment beside the header."""
    u, y = _volts(m)
    head = f"X,CH1,CH2,Start,Increment,\nSequence,VOLT,VOLT,{-1.0:e},{1 / RATE_HZ:e}\n"
    rows = "".join(f"{i},{a:.4e},{b:.6e},,\n" for i, (a, b) in enumerate(zip(u, y, strict=True)))
    return Export(".csv", (head + rows).encode(), *_scope("CH1", "CH2"))


def lecroy_wavesurfer(m: Motion) -> Export:
    """LeCroy: segments, `Time,Ampl`, one file for each channel joined by hand."""
    u, y = _volts(m)
    head = (
        f"LECROYWS3024,50001,Waveform\nSegments,1,SegmentSize,{len(u)}\n"
        "Segment,TrigTime,TimeSinceSegment1\n#1,17-May-2024 09:41:02,0\nTime,Ampl1,Ampl2\n"
    )
    return Export(
        ".csv",
        (head + _table([m.time_s - 2.5, u, y], ",", "%.9g")).encode(),
        *_scope("Ampl1", "Ampl2"),
    )


def rohde_schwarz_rtb(m: Motion) -> Export:
    """Rohde & Schwarz: `in s,C1 in V`."""
    u, y = _volts(m)
    text = "in s,C1 in V,C2 in V\n" + _table([m.time_s, u, y], ",", "%.8E")
    return Export(".csv", text.encode(), *_scope("C1", "C2"))


def picoscope(m: Motion) -> Export:
    """PicoScope: units in a line of their own, ms, an infinity sign for overload."""
    u, y = _volts(m)
    cells = [f"{value:.7f}" for value in y]
    cells[100] = "∞"
    head = "Time,Channel A,Channel B\n(ms),(V),(mV)\n\n"
    scaled = [f"{1e3 * float(c):.5f}" if c != "∞" else c for c in cells]
    text = head + _table([1e3 * m.time_s, u, scaled], ",")
    return Export(
        ".csv",
        ("\ufeff" + text).encode(),
        Channel("Channel A", NEWTON_PER_VOLT),
        Channel("Channel B", METRE_PER_VOLT * 1e-3),
    )


def labview_lvm(m: Motion) -> Export:
    """LabVIEW measurement file: two header blocks, a column for comments."""
    u, y = _volts(m)
    head = (
        "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\n"
        "Decimal_Separator\t.\nMulti_Headings\tNo\nX_Columns\tOne\nTime_Pref\tRelative\n"
        "Operator\tlab\nDate\t2024/05/17\nTime\t09:41:02.1234567890123456789\n"
        f"***End_of_Header***\t\n\t\nChannels\t2\t\t\nSamples\t{len(u)}\t{len(u)}\t\n"
        "Date\t2024/05/17\t2024/05/17\t\nTime\t09:41:02.125\t09:41:02.125\t\n"
        "Y_Unit_Label\tVolts\tVolts\t\nX_Dimension\tTime\tTime\t\n"
        f"X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t\nDelta_X\t{1 / RATE_HZ:.6f}"
        f"\t{1 / RATE_HZ:.6f}\t\n***End_of_Header***\t\t\t\nX_Value\tForce\tPosition\tComment\n"
    )
    text = head + _table([m.time_s, u, y], "\t", "%.7f")
    return Export(".lvm", text.replace("\n", "\r\n").encode(), *_scope("Force", "Position"))


def dspace_controldesk(m: Motion) -> Export:
    """dSPACE ControlDesk: several lines of text, names with paths and a line of units."""
    head = (
        '"Experiment";"mass_on_spring"\n"Variable description";"mass.sdf"\n'
        '"Device";"MicroLabBox"\n\n'
        '"Platform()://Task/xAxis";"Platform()://Model Root/Force/Out1";'
        '"Platform()://Model Root/Position/Out1"\n"s";"N";"mm"\n'
    )
    text = head + _table([m.time_s, m.force_n, 1e3 * m.position_m], ";", "%.8g")
    return Export(
        ".csv",
        text.encode(),
        Channel("Platform()://Model Root/Force/Out1"),
        Channel("Platform()://Model Root/Position/Out1"),
    )


def vector_canoe(m: Motion) -> Export:
    """Vector CANoe: signals in brackets, semicolons, a cell is empty where no message came."""
    text = "Time[s];Actuator::Force[N];Encoder::Position[um]\n"
    cells = [f"{1e6 * value:.1f}" for value in m.position_m]
    cells[50], cells[1200] = "", ""
    text += _table([m.time_s + 12.34567, m.force_n, cells], ";", "%.6f")
    return Export(".csv", text.encode(), Channel("Actuator::Force"), Channel("Encoder::Position"))


def matlab_timetable(m: Motion) -> Export:
    """MATLAB writetimetable: durations with their unit in each cell."""
    cells = [f"{t:g} sec" for t in m.time_s]
    text = "Time,force_N,position_mm\n" + _table([cells, m.force_n, 1e3 * m.position_m], ",")
    return Export(".csv", text.encode(), Channel("force_N", 1.0), Channel("position_mm"))


def hbm_catman(m: Motion) -> Export:
    """HBM catman: a long header, names with units, decimal commas, Windows-1252."""
    head = (
        "CATMAN DATEIEXPORT\nDatei:\tFeder-Masse_Prüfstand.tst\nT0 = 17.05.2024 09:41:02\n"
        + "".join(f"Sensor {i}:\tMX840B_{i}\tBrücke\n" for i in range(30))
        + "Zeit  1 - Standardmessrate [s]\tKraft [N]\tWeg [µm]\n"
        + "MX840B 'Kanal 1'\tKanal 2\tKanal 3\n"
    )
    text = head + _german(_table([m.time_s, m.force_n, 1e6 * m.position_m], "\t", "%.7g"))
    return Export(".asc", text.encode("cp1252"), Channel("Kraft"), Channel("Weg"))


def twincat_scope(m: Motion) -> Export:
    """Beckhoff TwinCAT Scope: a time column in ms for each channel, entries, EOF at the end."""
    head = (
        "Name\tYT Scope Project\nFile\tC:\\Scope.tcscopex\nStarttime of export\t"
        "133604376620000000\tFriday, 17 May 2024\t09:41:02.000\nEndtime of export\t"
        "133604376820000000\tFriday, 17 May 2024\t09:41:22.000\n\n"
        "Name\tForce\tName\tPosition\nSymbolComment\t\tSymbolComment\t\n"
        "Data-Type\tREAL64\tData-Type\tREAL64\n"
        f"SampleTime[ms]\t{1e3 / RATE_HZ:g}\tSampleTime[ms]\t{1e3 / RATE_HZ:g}\n"
        "VariableSize\t8\tVariableSize\t8\nSymbolBased\tTrue\tSymbolBased\tTrue\n"
        "Offset\t0\tOffset\t0\nScaleFactor\t1\tScaleFactor\t1\n\n"
    )
    ms = [f"{1e3 * t:g}" for t in m.time_s]
    text = head + _german(_table([ms, m.force_n, ms, m.position_m], "\t")) + "EOF\n"
    return Export(".csv", text.encode(), Channel("Force", 1.0), Channel("Position", 1.0))


def siemens_trace(m: Motion) -> Export:
    """Siemens trace: sample number, time since 1970 in ms, semicolons."""
    since_ms = 1e3 * (_START.timestamp() + m.time_s)
    head = 'Sample;Timestamp;"Drive".Force;"Drive".Position\n'
    rows = "".join(
        f"{i};{t:.0f};{a:.7f};{b:.8f}\n"
        for i, (t, a, b) in enumerate(zip(since_ms, m.force_n, m.position_m, strict=True), 1)
    )
    return Export(
        ".csv", (head + rows).encode(), Channel("Drive.Force", 1.0), Channel("Drive.Position", 1.0)
    )


def rostopic_echo(m: Motion) -> Export:
    """ROS `rostopic echo -p`: a header that begins with %, stamps in ns since 1970."""
    begin_ns = int(_START.timestamp()) * 1_000_000_000
    ns = [str(begin_ns + round(1e9 * t)) for t in m.time_s]
    seq = [str(5000 + i) for i in range(len(ns))]
    head = "%time,field.header.seq,field.header.stamp,field.effort0,field.position0\n"
    text = head + _table([ns, seq, ns, m.force_n, m.position_m], ",", "%.10g")
    return Export(
        ".csv", text.encode(), Channel("field.effort0", 1.0), Channel("field.position0", 1.0)
    )


def ros2_seconds_and_nanoseconds(m: Motion) -> Export:
    """ROS 2: seconds and nanoseconds in two columns."""
    begin = int(_START.timestamp())
    total = [begin * 10**9 + 400_000_000 + round(1e9 * t) for t in m.time_s]
    sec, nano = [str(t // 10**9) for t in total], [str(t % 10**9) for t in total]
    head = "header.stamp.sec,header.stamp.nanosec,effort,position\n"
    text = head + _table([sec, nano, m.force_n, m.position_m], ",", "%.10g")
    return Export(".csv", text.encode(), Channel("effort", 1.0), Channel("position", 1.0))


def dewesoft(m: Motion) -> Export:
    """Dewesoft: a block of entries, then names with units in round brackets, tabs."""
    head = (
        f"Data export settings:\nFile name: mass.dxd\nStart time: 17.5.2024 9:41:02.125\n"
        f"Number of channels: 2\nSample rate: {RATE_HZ:g} Hz\nStore type: always fast\n\n"
        "Time (s)\tForce (N)\tPosition (mm)\n"
    )
    text = head + _table([m.time_s, m.force_n, 1e3 * m.position_m], "\t")
    return Export(".txt", text.encode(), Channel("Force"), Channel("Position"))


def drive_recorder(m: Motion) -> Export:
    """A servo drive's recorder: a title, three header lines, an index, no time."""
    head = (
        "Recorder data of axis 1\n"
        f"Sampling interval: {1e6 / RATE_HZ:g} us\n\n"
        "Index,Active force,Position feedback\nREAL,REAL,REAL\n-,N,mm\n"
    )
    rows = [str(i) for i in range(len(m.time_s))]
    text = head + _table([rows, m.force_n, 1e3 * m.position_m], ",")
    return Export(".csv", text.encode(), Channel("Active force"), Channel("Position feedback"))


def spreadsheet_time_of_day(m: Motion) -> Export:
    """A logger with date and time of day in two columns, over midnight, decimal commas."""
    begin = datetime(2024, 5, 17, 23, 59, 51, 300_000, tzinfo=UTC)
    when = [begin + timedelta(seconds=float(t)) for t in m.time_s]
    dates = [w.strftime("%d.%m.%Y") for w in when]
    clock = [w.strftime("%H:%M:%S,%f")[:-3] for w in when]
    force = [_german(f"{value:.6f}") for value in m.force_n]
    position = [_german(f"{1e3 * value:.5f}") for value in m.position_m]
    head = "Datum;Uhrzeit;Kraft;Weg\ndd.mm.yyyy;hh:mm:ss,000;N;mm\n"
    text = head + _table([dates, clock, force, position], ";")
    return Export(".csv", text.encode("utf-16"), Channel("Kraft"), Channel("Weg"))


def microcontroller(m: Motion) -> Export:
    """A serial monitor's log: a 32-bit counter of us that overflows, the first line cut."""
    us = (2**32 - 7_000_000 + np.round(1e6 * m.time_s).astype(np.int64)) % 2**32
    text = "12,0.0031\n" + "micros,force,position\n"
    text += _table([us.astype(str).tolist(), m.force_n, m.position_m], ",")
    return Export(".csv", text.encode(), Channel("force", 1.0), Channel("position", 1.0))


def saleae(m: Motion) -> Export:
    """Saleae Logic 2: `Time [s]`, stamps as ISO dates with an offset and nanoseconds."""
    u, y = _volts(m)
    when = [_START + timedelta(seconds=float(t)) for t in m.time_s]
    stamps = [w.strftime("%Y-%m-%dT%H:%M:%S.%f000+02:00") for w in when]
    text = "Time [s],Channel 0,Channel 1\n" + _table([stamps, u, y], ",", "%.9f")
    return Export(".csv", text.encode(), *_scope("Channel 0", "Channel 1"))


def labview_segments(m: Motion) -> Export:
    """LabVIEW: a head before each segment, a time for each channel, decimal commas."""
    size, text = len(m.time_s) // 4, "LabVIEW Measurement\t\nX_Columns\tMulti\n"
    text += "***End_of_Header***\t\n\t\n"
    for begin in range(0, 4 * size, size):
        part = slice(begin, begin + size)
        t = m.time_s[part]
        head = (
            f"Channels\t2\t\t\t\nSamples\t{size}\t\t{size}\t\nDate\t2024/05/17\t\t2024/05/17\t\n"
            f"Y_Unit_Label\tNewtons\t\tmm\t\nX0\t{t[0]:.7f}\t\t{t[0]:.7f}\t\n"
            f"Delta_X\t{1 / RATE_HZ:.6f}\t\t{1 / RATE_HZ:.6f}\t\n***End_of_Header***\t\t\t\t\n"
            "X_Value\tForce\tX_Value\tPosition\tComment\n"
        )
        text += head + _table([t, m.force_n[part], t, 1e3 * m.position_m[part]], "\t", "%.7f")
    return Export(".lvm", _german(text).encode(), Channel("Force", 1.0), Channel("Position", 1e-3))


def pandas_timedelta(m: Motion) -> Export:
    """Pandas: durations as the index, which has no name."""
    text = ",F [N],x [mm]\n"
    for t, a, b in zip(m.time_s, m.force_n, 1e3 * m.position_m, strict=True):
        text += f"0 days {timedelta(seconds=float(t))!s:0>8},{a:.7g},{b:.7g}\n"
    return Export(".csv", text.encode(), Channel("F"), Channel("x"))


def lock_in(m: Motion) -> Export:
    """Zurich Instruments: a comment as header, time in ticks of a clock of 60 MHz."""
    ticks = (123_456_789 + 60e6 * m.time_s).astype(np.int64).astype(str).tolist()
    u, y = _volts(m)
    text = "%% chunk;timestamp;aux0;aux1\n" + _table([["0"] * len(u), ticks, u, y], ";")
    return Export(".csv", text.encode(), *_scope("aux0", "aux1"), tick_s=1 / 60e6)


EXPORTS: dict[str, Callable[[Motion], Export]] = {
    f.__name__: f
    for f in (
        *(tektronix_tds, tektronix_mso, keysight_infiniivision, rigol_ds1000z, lecroy_wavesurfer),
        *(rohde_schwarz_rtb, picoscope, labview_lvm, dspace_controldesk, vector_canoe),
        *(matlab_timetable, hbm_catman, twincat_scope, siemens_trace, rostopic_echo),
        *(ros2_seconds_and_nanoseconds, dewesoft, drive_recorder, spreadsheet_time_of_day),
        *(microcontroller, saleae, labview_segments, pandas_timedelta, lock_in),
    )
}
