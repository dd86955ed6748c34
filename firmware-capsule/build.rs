//! How the image is linked.
#[path = "../device/link_arguments.rs"]
mod link_arguments;

fn main() {
    link_arguments::print();
}
