"""What runs in a process of levid: packages, compiled code and files of code, and from where."""
