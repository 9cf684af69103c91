"""The public names and where they come from; ``__init__.py`` imports them on first use."""

from calibgraph.calibration import Calibration as Calibration
from calibgraph.calibration import Residuals as Residuals
from calibgraph.calibration import load_calibration as load_calibration
from calibgraph.check import Check as Check
from calibgraph.check import Verdict as Verdict
from calibgraph.config import Config as Config
from calibgraph.config import load_config as load_config
from calibgraph.config import preset as preset
from calibgraph.correspondence_file import load_correspondences as load_correspondences
from calibgraph.correspondences import Correspondences as Correspondences
from calibgraph.correspondences import concatenate as concatenate
from calibgraph.dataset import Dataset as Dataset
from calibgraph.dataset import Frame as Frame
from calibgraph.dataset import load_dataset as load_dataset
from calibgraph.errors import CalibrationError as CalibrationError
from calibgraph.errors import CorrespondenceError as CorrespondenceError
from calibgraph.errors import DatasetError as DatasetError
from calibgraph.errors import FileError as FileError
from calibgraph.errors import RigError as RigError
from calibgraph.load import load_rig as load_rig
from calibgraph.metrics import Evaluation as Evaluation
from calibgraph.metrics import PoseError as PoseError
from calibgraph.metrics import evaluate as evaluate
from calibgraph.perturbation import perturb as perturb
from calibgraph.pipeline import Matcher as Matcher
from calibgraph.pipeline import calibrate as calibrate
from calibgraph.rig import Camera as Camera
from calibgraph.rig import Intrinsics as Intrinsics
from calibgraph.rig import RelativePose as RelativePose
from calibgraph.rig import Rig as Rig
from calibgraph.simulation.correspondences import MatcherErrors as MatcherErrors
from calibgraph.simulation.correspondences import (
    simulate_correspondences as simulate_correspondences,
)
from calibgraph.simulation.recording import simulate_street as simulate_street
from calibgraph.structure import StructureMatcher as StructureMatcher
from calibgraph.tracking import DurableCalibrator as DurableCalibrator
from calibgraph.tracking import Event as Event
from calibgraph.tracking import IncrementalCalibrator as IncrementalCalibrator
from calibgraph.tracking import Update as Update
from calibgraph.two_pass import solve as solve
from factors import block_factor as block_factor
from factors import camera_prior_factor as camera_prior_factor
from factors import projection_factor as projection_factor
from factors import relative_pose_factor as relative_pose_factor
from factors import relative_prior_factor as relative_prior_factor
