"""The feature `recorder`: starts, controls and monitors the recorder's process."""
