"""Texts of vendors' exports, small ones."""

from collections.abc import Sequence

import numpy as np

# A platform of 4 rows x 3 columns; columns 2, 3 and rows 2..4 were touched. 0.25 cm2: x 0.025.
EMED_KPA = [
    [[0.0, 10.0], [20.0, 40.0], [0.0, 0.0]],
    [[0.0, 15.0], [100.0, 0.0], [5.0, 0.0]],
]


def emed_page(number: str, table: list[list[float]] | None) -> str:
    page = (
        f"\n\t\t\t\tPage 1\n\n\tFile: foot.dat \tMatrix: 3x4 \n"
        "\tSensor area: 0.25 cm\xb2\tTime/picture:10.0 ms\n\tMV over frames\n"
        "\tSensor size: 0.500x0.500 cm\n\tnovel munich\n"
        f"\tPict-No.: {number}  Force[N]=sum*sensor_area in row/column\n\n"
    )
    if table is not None:
        page += "\t2\t3\tForce\n"
        for row, cells in enumerate(table, start=2):
            force = 0.025 * sum(cells)
            page += (
                f"{row}\t"
                + "\t".join(f"{kpa:.2f}" for kpa in cells)
                + f"\t{force:.2f}\n"
            )
        sums = [0.025 * sum(column) for column in zip(*table, strict=True)]
        page += "Force\t" + "\t".join(f"{n:.2f}" for n in [*sums, sum(sums)]) + "\n\f"
    return page


def emed_text() -> str:
    frames = "".join(
        emed_page(str(k), table) for k, table in enumerate(EMED_KPA, start=1)
    )
    peaks = np.max(EMED_KPA, axis=0).tolist()
    return frames + emed_page("MVP", peaks) + "\n\t\t\t\tPage 4\n\nno frame\n"


TEKSCAN_ROWS = [["B,1,2", "0,3,B"], ["B,0,5", "7,0,B"], ["B,0,0", "0,9,B"]]


def tekscan_text(
    unit: str = "raw", times: tuple[str, ...] = ("0", "0.1", "0.21")
) -> str:
    text = (
        "DATA_TYPE MOVIE\nVERSION Tekscan 6.10I\nROWS 2\nCOLS 3\n"
        "ROW_SPACING 0.127 centimeters\nCOL_SPACING 0.127 centimeters\n"
        f"SECONDS_PER_FRAME 0.1\nSTART_FRAME 1\nEND_FRAME 3\nUNITS {unit}\nASCII_DATA @@\n"
    )
    for number, (rows, time) in enumerate(
        zip(TEKSCAN_ROWS, times, strict=True), start=1
    ):
        cells = ",".join(rows).split(",")
        total = sum(int(cell) for cell in cells if cell != "B")
        text += f"\nFrame {number}, {time},, 12/2/2019,,,Raw Sum=,,{total}\n"
        text += "\n".join(rows) + "\n"
    return text + "@@\n"


#: An insole of 3 x 4 cells of which 7 exist, printed as 0 where there is none.
XSENSOR_FRAMES = [
    ["0,10.5,20,0", "3,0,7.25,0", "0,1,0,0"],
    ["0,0,30,0", "0,12,0,0", "0,2.5,0,5"],
    ["0,11,0,0", "0,0,8,0", "0,0,0,0"],
]


def xsensor_sensor(name: str, rows: Sequence[str], area: float, pad: str) -> list[str]:
    peak = max(float(cell) for row in rows for cell in row.split(",") if cell)
    return [
        f"SENSOR,{name}",
        f"Rows,{len(rows)}",
        f"Columns,{rows[0].count(',') + 1}",
        "Sensel Width (cm),0.86",
        "Sensel Height (cm),0.86",
        f"Peak Pressure (mmHg),{peak:g}",
        f"Total Area (cm\xb2),{area:.2f}",
        "SENSELS",
        *(row + pad for row in rows),
    ]


def xsensor_text(
    frames: Sequence[Sequence[str]] = XSENSOR_FRAMES,
    times: Sequence[str] = ("08:21:17.982", "08:21:17.995", "08:21:18.008"),
    area: float = 7 * 0.86 * 0.86,
    pad: str = ",,,",
    unit: str = "mmHg",
) -> str:
    """An export of two sensors and a group, as the software lays it out."""
    lines = [
        '\xef\xbb\xbfFile:,"C:\\foot-8,16.XSN",,',
        f"Units:,{unit},,",
        "Threshold:,0.5,,",
    ]
    for number, (rows, time) in enumerate(zip(frames, times, strict=True), start=1464):
        lines += [f"FRAME,{number},,", "Date, 2022 Aug 16,,", f"Time, {time},,"]
        lines += xsensor_sensor("LF", rows, area, pad)
        lines += xsensor_sensor("RF", ["9,9,9,9"], area, pad)
        lines += ["GROUP,1,,", "Name,Left Heel", "Cells,2", "SENSELS", "5,6,,"]
    return "\n,,,\n".join(lines) + "\n"
