"""`python -m jaxslam`: the commands."""

import sys

from jaxslam.cli import main

sys.exit(main())
