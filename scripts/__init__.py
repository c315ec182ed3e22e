"""One file a command, behind the console command ``shepherd-phys``."""
