//! The `demc` program: parses the command line, runs, prints the error.

fn main() -> std::process::ExitCode {
    demc::cli::main()
}
