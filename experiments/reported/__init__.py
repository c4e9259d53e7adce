"""Problems that people brought to other tools, and that the library once answered wrongly, each as a small script."""
