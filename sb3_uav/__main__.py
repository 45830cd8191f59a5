"""``python -m sb3_uav``: the command ``sb3-uav``."""

import sys

from sb3_uav.cli.main import main

sys.exit(main())
