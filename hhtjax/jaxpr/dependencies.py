def dependencies(f, x):
    raise NotImplementedError
