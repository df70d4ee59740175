"""The feature `recorder`: starts, steers and watches the recorder's process."""
