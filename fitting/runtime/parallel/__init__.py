"""Work that is shared out to other processes, on this machine or on others."""
