"""The embedding observation module of section 3.1 (P10): from pictures of the head camera to the state vector s_t."""
