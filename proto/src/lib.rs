//! Messages, service names and quality of service of the grnet pose stream
