"""Compressed sensing for robot tactile skins.

But for `subscribe`, which reads a running graph, the names below work on arrays, in one program,
with no process and no socket. Each is imported when it is first used. The node set is in
`sparseskin.nodes`, the launcher in `sparseskin.launch`.
"""

from importlib import import_module

TYPE_CHECKING = (
    False  # as of `typing`, without its import: the command imports this first
)

if TYPE_CHECKING:
    from sparseskin.launch.attach.subscription import Subscription, subscribe
    from sparseskin.launch.launchfile.load import load as load_launch
    from sparseskin.nodes.compressor.phi.base import make_phi
    from sparseskin.nodes.errors import SparseskinError
    from sparseskin.nodes.reconstructor.bases.base import make_basis
    from sparseskin.nodes.reconstructor.contacts import find_contacts
    from sparseskin.nodes.sensor.noise import NoiseModel

    from .arrays import (
        compress,
        make_solver,
        psnr_db,
        reconstruct,
        run_launch,
        simulate,
    )
    from .checks import check_basis, check_phi, check_solver
    from .plots import plot_forces
    from .recordings import read_recording
    from .stream import Stream

    __version__: str

__all__ = [
    "NoiseModel", "SparseskinError", "Stream", "Subscription", "__version__", "check_basis",
    "check_phi", "check_solver", "compress", "find_contacts", "load_launch", "make_basis",
    "make_phi", "make_solver", "plot_forces", "psnr_db", "read_recording", "reconstruct",
    "run_launch", "simulate", "subscribe",
]  # fmt: skip

#: Module of each name, where it is not `arrays`.
_HOMES = {
    "make_phi": "sparseskin.nodes.compressor.phi.base",
    "make_basis": "sparseskin.nodes.reconstructor.bases.base",
    "check_phi": "sparseskin.checks",
    "check_basis": "sparseskin.checks",
    "check_solver": "sparseskin.checks",
    "find_contacts": "sparseskin.nodes.reconstructor.contacts",
    "NoiseModel": "sparseskin.nodes.sensor.noise",
    "plot_forces": "sparseskin.plots",
    "SparseskinError": "sparseskin.nodes.errors",
    "Subscription": "sparseskin.launch.attach.subscription",
    "subscribe": "sparseskin.launch.attach.subscription",
    "Stream": "sparseskin.stream",
    "read_recording": "sparseskin.recordings",
    "load_launch": "sparseskin.launch.launchfile.load",
}


if not TYPE_CHECKING:  # which know the names above, and no others

    def __getattr__(name):
        if name == "__version__":
            from importlib.metadata import version

            return version("sparseskin")
        if name not in __all__:
            raise AttributeError(f"module 'sparseskin' has no attribute {name!r}")
        module = import_module(_HOMES.get(name, "sparseskin.arrays"))
        name_there = "load" if name == "load_launch" else name
        value = getattr(module, name_there)
        # So that it is looked up once.
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
