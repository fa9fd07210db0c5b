//! Ctrl-C and SIGTERM.

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock};

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

/// Becomes true with the first SIGINT or SIGTERM: save, then end. The second ends the process at once, with the status
/// that shells give for the signal; the files of a run folder bear that.
///
/// Every call gives the same flag.
pub fn stop_flag() -> Arc<AtomicBool> {
    static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();
    FLAG.get_or_init(|| {
        let stop = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM] {
            // In this order: the first signal finds the flag unset and goes on to set it.
            let watched = flag::register_conditional_shutdown(signal, 128 + signal, stop.clone())
                .and_then(|_| flag::register(signal, stop.clone()));
            if let Err(error) = watched {
                eprintln!("warning: signal {signal} will end the training without saving: {error}");
            }
        }
        stop
    })
    .clone()
}
