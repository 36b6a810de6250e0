"""`python -m jaxslam`: the commands."""

import sys

from jaxslam.cli.main import main

sys.exit(main())
