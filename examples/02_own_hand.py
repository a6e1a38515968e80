"""A hand of one's own from its URDF: a first hand.toml is drafted, the hand is checked, and it
grasps.
"""

import shutil
import tempfile
from pathlib import Path

from torchgrasp import load_hand, load_object, plan_grasps
from torchgrasp.app.author.draft import draft_hand
from torchgrasp.files import write_file
from torchgrasp.foundation.base import count_status
from torchgrasp.testing import check_hand

folder = Path(tempfile.mkdtemp()) / "mine"
folder.mkdir()
urdf = folder / "hand.urdf"
shutil.copy(load_hand("barrett").urdf_path, urdf)  # stands for the URDF of your own hand

# as `torchgrasp hand new`; read it and mend it
write_file(folder / "hand.toml", draft_hand(urdf))
hand = check_hand(folder)  # as `torchgrasp hand check`: raises with the rule that a file breaks
print(f"{hand.name}: {hand.dof} actuated joints, fingers {', '.join(hand.tips.names)}")

grasps = plan_grasps(load_object("cylinder").view, hand, starts=50)
print({status.name: count for status, count in count_status(grasps.status).items()})
