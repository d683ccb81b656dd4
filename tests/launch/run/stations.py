"""A station of graphs of several hosts, for tests: copied beside their launch files."""

from sparseskin.nodes.node import Node
from sparseskin.nodes.settings import PatchSettings


class Echo(Node):
    """Reads taxels, and logs the first."""

    Settings = PatchSettings
    says_so = False

    @classmethod
    def inputs(cls, settings):
        return (f"/{settings.patch}/taxels",)

    def step(self, message):
        if not self.says_so:
            self.says_so = True
            self.context.log("takes frames")
        return ()
