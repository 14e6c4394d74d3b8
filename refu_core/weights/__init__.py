"""Trained weights: safetensors beside a JSON card; and the weights that ship, one folder per garment."""

from refu_core.weights._config import build_for as build_for
from refu_core.weights._config import config_of_card as config_of_card
from refu_core.weights._config import naming as naming
from refu_core.weights._files import FORMAT as FORMAT
from refu_core.weights._files import Weights as Weights
from refu_core.weights._files import in_steps as in_steps
from refu_core.weights._files import load_card as load_card
from refu_core.weights._files import load_weights as load_weights
from refu_core.weights._files import save_weights as save_weights
from refu_core.weights._files import weights_folder as weights_folder
