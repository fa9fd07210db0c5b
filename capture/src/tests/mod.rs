//! Whole recordings: made in a temporary folder, read, and played.

mod made;
mod playing;
mod reading;
mod reading_more;
mod real_data;
