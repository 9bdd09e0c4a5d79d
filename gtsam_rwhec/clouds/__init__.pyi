from .cloud import Cloud as Cloud
from .lidar_boards import BeamBiases as BeamBiases
from .lidar_boards import LidarBoard as LidarBoard
from .lidar_boards import LidarBoardOptions as LidarBoardOptions
from .lidar_boards import find_board as find_board
from .lidar_camera import SeenBoards as SeenBoards
from .lidar_camera import lidar_and_camera as lidar_and_camera
from .lidar_camera import seen_boards as seen_boards
