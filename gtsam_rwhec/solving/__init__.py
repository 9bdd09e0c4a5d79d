"""The globally optimal calibration of a problem with its certificate, and the certificate of anybody's answer."""
