"""File formats of vendors."""

from sparseskin.nodes.sensor.files.format import Format

from .emed import EmedRecording
from .hdf5 import Hdf5Recording
from .matlab import MatlabRecording
from .tekscan import TekscanRecording, is_tekscan
from .xsensor import XsensorRecording, is_xsensor

EMED = Format(
    {".lst": "Novel emed text export"}, lambda file: EmedRecording(file.lines)
)
TEKSCAN = Format(
    {".asf": "Tekscan ASCII movie export", ".csv": "Tekscan ASCII movie export"},
    lambda file: TekscanRecording(file.lines),
    is_tekscan,
)
XSENSOR = Format(
    {".csv": "XSENSOR export"}, lambda file: XsensorRecording(file.lines), is_xsensor
)
MATLAB = Format({".mat": "MATLAB"}, MatlabRecording)
HDF5 = Format({".h5": "HDF5", ".hdf5": "HDF5"}, Hdf5Recording)
