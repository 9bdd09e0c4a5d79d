from .cloud import Cloud as Cloud
from .cloud_files import read_cloud as read_cloud
