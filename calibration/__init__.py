"""What is fitted once, offline, and handed to the filter as `Params`."""
