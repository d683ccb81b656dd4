"""Stations of graphs of several hosts, for tests: copied beside their launch files."""

from sparseskin.messages import Reconstruction
from sparseskin.nodes.node import Node
from sparseskin.nodes.settings import PatchSettings


class Echo(Node):
    """Takes what the taxels read for restored: no solver has to be loaded."""

    Settings = PatchSettings
    says_so = False

    @classmethod
    def inputs(cls, settings):
        return (f"/{settings.patch}/taxels",)

    @classmethod
    def outputs(cls, settings):
        return (f"/{settings.patch}/reconstruction",)

    def step(self, message):
        if not self.says_so:
            self.says_so = True
            self.context.log("takes frames")
        now_ns = self.context.clock.now_ns()
        yield Reconstruction(
            stamp_ns=message.stamp_ns,
            patch=message.patch,
            forces=message.forces[0],
            phi="0" * 16,
            iterations=(1,),
            residual=(0.0,),
            solve_ns=(0,),
            done_ns=now_ns,
        )
