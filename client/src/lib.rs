//! Client library and command of the grnet pose stream
