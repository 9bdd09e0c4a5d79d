from .folder_contents import is_folder_without_logs as is_folder_without_logs
from .folder_proposal import propose_folder_rig as propose_folder_rig
from .proposal import propose_rig as propose_rig
from .templates import TEMPLATES as TEMPLATES
from .templates import template_text as template_text
