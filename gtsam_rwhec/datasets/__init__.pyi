from .demo_log import LOG as LOG
from .demo_log import RIG as RIG
from .demo_log import demo_folder as demo_folder
from .download import UTIAS_URL as UTIAS_URL
from .download import Fetched as Fetched
from .download import fetch_utias as fetch_utias
from .download import utias_files as utias_files
