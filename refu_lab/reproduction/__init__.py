"""The paper's tables and figures on our own data, each figure beside the paper's, for `refu evaluate`."""

from refu_lab.reproduction._evaluate import evaluate as evaluate
from refu_lab.reproduction._evaluate import results_dict as results_dict
from refu_lab.reproduction._evaluate import results_text as results_text
from refu_lab.reproduction._motion import OutfitJudge as OutfitJudge
from refu_lab.reproduction._motion import figures_of as figures_of
from refu_lab.reproduction._motion import frame_pair as frame_pair
from refu_lab.reproduction._tables import METRICS as METRICS
from refu_lab.reproduction._tables import published_modes as published_modes
