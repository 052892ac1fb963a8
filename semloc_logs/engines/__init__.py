"""Where tasks run: in this process or in several; a stage receives an engine and never makes one."""
