//! Frame sources: dataset folders and image folders
