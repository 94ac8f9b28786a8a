//! (edit)
pub struct NewChannel;
pub struct Recoded;
