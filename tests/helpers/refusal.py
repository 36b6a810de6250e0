"""For tests of readers: how one refuses."""

import pytest

from jaxslam.logs.readers import read


def refused(paths, message, robot=None):
    """The reader refuses in one line that names a file."""
    with pytest.raises(ValueError, match=message) as caught:
        read(paths, robot)
    paths = paths if isinstance(paths, list) else [paths]
    assert any(str(path) in str(caught.value) for path in paths), caught.value
    assert "\n" not in str(caught.value)
