from .cloud import Cloud as Cloud
<<<<<<< HEAD
from .cloud_files import read_cloud as read_cloud
from .registered_views import ObjectOptions as ObjectOptions
from .object_views import SeenObject as SeenObject
from .registered_views import ViewFault as ViewFault
from .registered_views import ViewFinding as ViewFinding
from .object_views import motions as motions
from .object_views import seen_object as seen_object
from .registration import Registrations as Registrations
=======
from .beams import deskewed as deskewed
>>>>>>> lidar
from .lidar_boards import BeamBiases as BeamBiases
from .lidar_boards import LidarBoard as LidarBoard
from .lidar_boards import LidarBoardOptions as LidarBoardOptions
from .lidar_boards import find_board as find_board
from .lidar_camera import SeenBoards as SeenBoards
from .lidar_camera import lidar_and_camera as lidar_and_camera
from .lidar_camera import seen_boards as seen_boards
from .shapes import SeenPlane as SeenPlane
from .shapes import SeenSphere as SeenSphere
from .shapes import find_plane as find_plane
from .shapes import find_sphere as find_sphere
from .depth_boards import DepthBoard as DepthBoard
from .depth_boards import board_in_depth as board_in_depth
