def show_replay(file, drive):
    raise NotImplementedError
