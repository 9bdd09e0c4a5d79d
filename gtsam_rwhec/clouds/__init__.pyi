from .cloud import Cloud as Cloud
