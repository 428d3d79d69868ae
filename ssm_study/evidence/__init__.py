"""Whether data and model allow a judgement of the plant at all."""
