"""Charts of studies are drawn, but not laid out, which takes longer than all else."""

import pytest


@pytest.fixture(autouse=True)
def plain_layout(request):
    """Leave out the layout of charts, but in the tests of charts themselves."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.stem != "test_report":
            try:
                from matplotlib.layout_engine import ConstrainedLayoutEngine
            except ImportError:
                pass
            else:
                patch.setattr(ConstrainedLayoutEngine, "execute", lambda self, figure: None)
        yield
